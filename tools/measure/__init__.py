"""Measurements of flights, networks and perception."""
