"""What the pilots of a simulated flock ask for in one step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from flockd.core.messages import NO_STATUS, FloatArray, MissionStatus, Neighbour, ObstacleRanges


@dataclass(frozen=True, eq=False)
class Commands:
    """What n drones are asked for in one step."""

    velocity: FloatArray
    """(n, 2) m/s, north and east."""
    acceleration: FloatArray
    """(n, 2) m/s^2; 0 of a drone that is flown by hand."""
    yaw_rad: FloatArray
    """(n,)"""
    height_m: FloatArray
    """(n,), up positive; NaN: as high as now."""
    missions: tuple[MissionStatus, ...]
    """See `PilotOutput.mission`."""
    desired: FloatArray
    """(n, 2) m/s: what each mission wants, times its pull."""
    obstacles: tuple[ObstacleRanges | None, ...]
    """What each drone saw of them; None where it does not look for any."""
    neighbours: tuple[tuple[Neighbour, ...], ...]
    """What each drone knows of the others."""

    @classmethod
    def of(cls, n: int) -> Self:
        """Standstill of n drones, to be filled."""
        still = (np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.full(n, np.nan))
        return cls(
            *still, missions=(NO_STATUS,) * n, desired=np.zeros((n, 2)), obstacles=(None,) * n, neighbours=((),) * n
        )

    @property
    def takeovers(self) -> list[str | None]:
        """Which autopilots take over, and how."""
        return [mission.takeover for mission in self.missions]
