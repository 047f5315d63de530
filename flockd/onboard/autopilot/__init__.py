"""The autopilot: one link to it, the stream of setpoints, and a fake for tests and the simulator."""
