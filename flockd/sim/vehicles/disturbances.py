"""What someone does to a simulated flock while it flies: gusts, cameras switched off, drones taken out of the world."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Disturbances:
    """As of one step. Drones are counted from 0."""

    gust_m_s: float | None = None
    """As `vehicle.gust_m_s` of the scenario; None: that one."""
    cameras_off: frozenset[tuple[int, str]] = frozenset()
    """Of drones, by name: they deliver no images."""
    removed: frozenset[int] = frozenset()
    """Drones that are in the world no more."""

    def cameras_off_of(self, drone: int) -> frozenset[str]:
        """The names of those of one drone."""
        return frozenset(name for i, name in self.cameras_off if i == drone)


UNDISTURBED = Disturbances()
