"""The log of a flight: what was true, what was estimated and what was commanded, step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.messages import BoolArray, FloatArray, IntArray
from flockd.review.flight_log.metadata import FlightMetadata

_S, _N = -1, -2
SHAPES: dict[str, tuple[int, ...]] = {
    "time_s": (_S,),
    "position": (_S, _N, 3),
    "velocity": (_S, _N, 3),
    "attitude": (_S, _N, 3, 3),
    "desired": (_S, 2),
    "command_velocity": (_S, _N, 2),
    "ego_rotation": (_S, _N, 3, 3),
    "ego_translation": (_S, _N, 3),
    "own_velocity_estimate": (_S, _N, 3),
    "neighbour_position": (_S, _N, _N, 3),
    "neighbour_velocity": (_S, _N, _N, 3),
    "false_tracks": (_S, _N),
    "goal": (_S, 2),
    "clearance": (_S, _N),
    "truth_position": (_S, _N, 3),
    "truth_velocity": (_S, _N, 3),
}
"""Shapes of a log's arrays with a row for each step; `shape_of` puts in the numbers of steps and drones."""
_STAGE_PREFIX = "stage "
_MAY_BE_EMPTY = ("goal", "clearance", "truth_position", "truth_velocity")


def shape_of(name: str, steps: int, drones: int) -> tuple[int, ...]:
    """Shape of an array of `SHAPES` in a log of so many steps and drones."""
    return tuple({_S: steps, _N: drones}.get(side, side) for side in SHAPES[name])


def spread(samples: FloatArray | Sequence[float], *wanted: str) -> dict[str, float | None]:
    """The ``wanted`` ones of mean, median, p95 and max of the finite samples, by name; None without any."""
    known = np.asarray(samples, float)
    known = known[np.isfinite(known)]
    of: dict[str, Callable[[FloatArray], Any]] = {
        "mean": np.mean, "median": np.median, "p95": lambda values: np.percentile(values, 95), "max": np.max,
    }  # fmt: skip
    return {name: float(of[name](known)) if len(known) else None for name in wanted}


@dataclass(frozen=True, eq=False)
class FlightLog:
    """S steps of N drones; NaN where there was no estimate, and where the truth is not known.

    A drone that was not recorded in a step has no command in it. Raises ValueError for shapes that do not fit together.
    """

    time_s: FloatArray
    """(S,) since the flight's start, when each step began."""
    position: FloatArray
    """(S, N, 3) m NED, true."""
    velocity: FloatArray
    """(S, N, 3) m/s NED, true."""
    attitude: FloatArray
    """(S, N, 3, 3) R_ned_body, true."""
    desired: FloatArray
    """(S, 2) m/s, the flock's desired velocity: the mean of its drones', each times its pull."""
    command_velocity: FloatArray
    """(S, N, 2) m/s, the setpoint of each step."""
    ego_rotation: FloatArray
    """(S, N, 3, 3) R_FC as estimated over the interval that ended with the step (Eq. 7)."""
    ego_translation: FloatArray
    """(S, N, 3) m, T_FC likewise, in body axes of the interval's start."""
    own_velocity_estimate: FloatArray
    """(S, N, 3) m/s NED, what the flocking law took for the own velocity."""
    neighbour_position: FloatArray
    """(S, N, N, 3) m NED: [s, i, j] is drone j relative to drone i by i's confirmed track of it."""
    neighbour_velocity: FloatArray
    """(S, N, N, 3) m/s NED over ground, likewise."""
    false_tracks: IntArray
    """(S, N) confirmed tracks that match no true drone and did not count before."""
    truth_position: FloatArray
    """(S2, N, 3) m NED of the same scenario flown with exact states, same time base; S2 is S, or 0
    without one."""
    truth_velocity: FloatArray
    """(S2, N, 3) m/s NED, likewise."""
    stages_ms: Mapping[str, FloatArray]
    """(K,) duration of each run of each stage."""
    metadata: FlightMetadata
    tracked: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    """(K, 6) each confirmed track at each step: step, observer, track, and metres north, east and down of it."""

    goal: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(S, 2) m north and east: where most drones that have a goal want to go, to the millimetre; NaN, or
    (0, 2), without one."""
    obstacles: FloatArray = field(default_factory=lambda: np.zeros((0, 7)))
    """(K, 7) each solid from above: metres north and east of its middle, half its length and width, the heading of its
    length (rad), and its lowest and highest height above z = 0. A round one has its radius as half length, and half
    width 0."""
    clearance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(S, N) m, the smallest distance of a drone's centre from an obstacle's surface from the step to the next, inside
    negative; (0, 0) without obstacles."""

    @property
    def has_truth(self) -> bool:
        """Whether it is known where the drones truly were."""
        return bool(np.isfinite(self.position).all())

    @property
    def recorded(self) -> BoolArray:
        """(S, N): which drones' steps are in it."""
        return np.asarray(np.isfinite(self.command_velocity).all(axis=2))

    @property
    def companion(self) -> tuple[FloatArray, FloatArray] | None:
        """Positions and velocities (S, N, 3) of the companion with exact states.

        None without one, and of a flight that flew on exact states itself.
        """
        if not len(self.truth_position) or not self.metadata.by_sight:
            return None
        return self.truth_position, self.truth_velocity

    def __post_init__(self) -> None:
        steps, drones = self.position.shape[:2]
        for name in SHAPES:
            have, shape = getattr(self, name).shape, shape_of(name, steps, drones)
            if have != shape and not (name in _MAY_BE_EMPTY and have[0] == 0):
                raise ValueError(f"{name} of a flight of {steps} steps and {drones} drones is {have}, not {shape}")

    def save(self, path: Path) -> None:
        """Write one compressed `.npz`."""
        arrays: dict[str, Any] = {
            part.name: getattr(self, part.name) for part in fields(self) if part.name not in ("stages_ms", "metadata")
        }
        arrays |= {_STAGE_PREFIX + stage: samples for stage, samples in self.stages_ms.items()}
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays, meta=self.metadata.model_dump_json(exclude_unset=True))

    @classmethod
    def load(cls, path: Path) -> FlightLog:
        """Read what `save` wrote. Raises OSError, or ValueError where the file is not a flight log."""
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        stages = {
            name.removeprefix(_STAGE_PREFIX): arrays.pop(name)
            for name in list(arrays)
            if name.startswith(_STAGE_PREFIX)
        }
        needed = {part.name for part in fields(cls) if part.default_factory is MISSING}
        missing = needed - {"stages_ms", "metadata"} - arrays.keys() | ({"meta"} - arrays.keys())
        if missing:
            raise ValueError(f"{path} is not a flight log: it has no {', '.join(sorted(missing))}")
        metadata = FlightMetadata.model_validate_json(str(arrays.pop("meta")))
        return cls(**arrays, stages_ms=stages, metadata=metadata)
