"""Drones cut out of renderings by Blender's Cycles, to be put onto photographs."""
