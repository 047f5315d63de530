"""True states from a simulator: recorded with a flight, for its evaluation. No code that flies reads them."""

from __future__ import annotations

from dataclasses import dataclass

from flockd.core.messages import Matrix3, Vector3


@dataclass(frozen=True, eq=False)
class TrueDrone:
    """The true state of one drone."""

    name: str
    position: Vector3
    """(3,) m NED, from the world's origin."""
    velocity: Vector3
    """(3,) m/s NED."""
    R_ned_body: Matrix3
    """(3, 3)"""
    exact_position: Vector3 | None = None
    """(3,) m NED in the companion flight on exact states; None in such a flight."""
    exact_velocity: Vector3 | None = None
    """(3,) m/s NED in the companion flight; None likewise."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The whole flock at the beginning of one step, including the own drone."""

    time_s: float
    drones: tuple[TrueDrone, ...]
    """In the same order in every step and every drone's recording."""
