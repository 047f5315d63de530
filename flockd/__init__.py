"""flockd: drones that flock by sight alone."""

__version__ = "0.2.0"
