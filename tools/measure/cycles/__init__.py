"""Perception on pictures of Blender's Cycles, a renderer that shares nothing with flockd's own."""
