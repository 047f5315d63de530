"""Cameras before a flight: which are plugged in, what they give, and the configuration that names them."""
