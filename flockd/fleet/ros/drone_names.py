"""Names of drones as parts of topics: ROS 2 takes letters, digits and `_`, and no digit first."""

from __future__ import annotations

import re


def ros_name(name: str) -> str:
    """The nearest name that ROS 2 takes."""
    plain = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", name))
    return f"d{plain}" if plain[:1].isdigit() else plain or "drone"


class DroneNames:
    """A namespace for each drone by its key `fleet/drone`; it keeps it, whoever else comes."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}

    def of(self, key: str) -> str:
        """Its own name, with its fleet's or a number where another drone has that already."""
        if key not in self._names:
            short, whole = ros_name(key.partition("/")[2]), ros_name(key)
            taken = set(self._names.values())
            numbered = (f"{whole}_{number}" for number in range(2, len(taken) + 3))
            self._names[key] = next(name for name in (short, whole, *numbered) if name not in taken)
        return self._names[key]
