"""Simulated vehicles and the wind. Fake autopilots are apart from them."""
