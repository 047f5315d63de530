"""Each drone's namespace."""

from __future__ import annotations

from flockd.onboard.ros.message_trees import ros_name


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
