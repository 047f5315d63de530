"""Calibrates cameras: their lenses, where they sit, and how their time and the autopilot's differ."""
