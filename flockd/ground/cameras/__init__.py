"""Cameras before a flight: a list, measurements, and their configuration."""
