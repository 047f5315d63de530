"""The autopilot: one link to it, and the stream of setpoints."""
