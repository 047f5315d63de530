"""Calibrates cameras: lens, mounting, and time offset to the autopilot."""
