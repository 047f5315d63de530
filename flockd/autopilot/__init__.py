"""The autopilot: one link to it, the stream of setpoints, and a stand-in for tests and the simulator."""
