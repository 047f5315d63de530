"""Fake autopilots, for simulation and tests."""
