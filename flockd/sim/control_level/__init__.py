"""Flocks without images: law, missions, avoidance and vehicles of many drones and many flights at once.

For questions that need hundreds of drones or thousands of flights. Each drone is given the others' exact states, or
what it would perceive with the errors of the networks' flights (`flockd.sim.scenario.perceived`), and exact ranges to
obstacles.
"""

from __future__ import annotations

from flockd.sim.control_level.flock_flights import fly_flocks

__all__ = ["fly_flocks"]
