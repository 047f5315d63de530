"""A recording for Rerun: what was recorded, and the maps that its networks give."""
