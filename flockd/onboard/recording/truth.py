"""True states from a simulator: recorded beside a flight, to evaluate it. Nothing that flies reads it."""

from __future__ import annotations

from dataclasses import dataclass

from flockd.core.messages import Matrix3, Vector3


@dataclass(frozen=True, eq=False)
class TrueDrone:
    """Where one drone of the flock truly was."""

    name: str
    position: Vector3
    """(3,) m NED, from the world's origin."""
    velocity: Vector3
    """(3,) m/s NED."""
    R_ned_body: Matrix3
    """(3, 3)"""
    exact_position: Vector3 | None = None
    """(3,) m NED in the companion flight, in which all drones had all exact states; None in such a flight."""
    exact_velocity: Vector3 | None = None
    """(3,) likewise."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The whole flock as one step began, the own drone among it."""

    time_s: float
    drones: tuple[TrueDrone, ...]
    """In the same order in every step and every drone's recording."""
