"""The typed configuration of a drone, and its loader."""

from flockd.core.config.drone import DroneConfig
from flockd.core.config.loader import Overrides, load_drone, load_real_drone
from flockd.core.config.real_drone import outside_envelope

__all__ = ["DroneConfig", "Overrides", "load_drone", "load_real_drone", "outside_envelope"]
