"""Flocks without images: law, missions and vehicles of many drones and many flights at once.

For questions that need hundreds of drones or thousands of flights. Each drone is given the others' exact states, or
what it would perceive with the errors of the networks' flights (`flockd.sim.scenario.perceived`).
"""

from __future__ import annotations

from flockd.sim.control_level.flock_flights import fly_flocks

__all__ = ["fly_flocks"]
