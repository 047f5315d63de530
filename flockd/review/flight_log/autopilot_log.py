"""What the autopilot itself logged of a flight, on the flight's own time."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flockd.core.messages import FloatArray

SERIES = (
    "setpoint_time_s",
    "setpoint_velocity",
    "setpoint_height_m",
    "flown_time_s",
    "flown_velocity",
    "flown_height_m",
)


class Span(NamedTuple):
    """Something that held for a while."""

    begin_s: float
    end_s: float
    what: str


class Said(NamedTuple):
    """A message of the autopilot."""

    time_s: float
    text: str


@dataclass(frozen=True, eq=False)
class AutopilotLog:
    """Times are seconds since the flight's start, heights metres above home."""

    source: str
    """The file's name."""
    placed_by: str
    """How it came onto the flight's time, for people."""
    drone: int
    """Its number in the flight's log."""
    setpoint_time_s: FloatArray
    """(K,)"""
    setpoint_velocity: FloatArray
    """(K, 2) m/s north and east that it was commanded; NaN where it flew by other means."""
    setpoint_height_m: FloatArray
    """(K,) likewise."""
    flown_time_s: FloatArray
    """(M,)"""
    flown_velocity: FloatArray
    """(M, 2) m/s, its own estimate."""
    flown_height_m: FloatArray
    """(M,)"""
    modes: tuple[Span, ...]
    """Flight modes in order, while it was logged."""
    failsafes: tuple[Span, ...]
    """While a failsafe was active."""
    said: tuple[Said, ...]
    """Warnings and worse."""

    def save(self, path: Path) -> None:
        """Writes one compressed `.npz`."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in SERIES}
        rest = {name: value for name, value in asdict(self).items() if name not in SERIES}
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays, rest=json.dumps(rest))

    @classmethod
    def load(cls, path: Path) -> AutopilotLog:
        """Reads what `save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in SERIES}
            rest = json.loads(str(file["rest"]))
        rest |= {name: tuple(Span(*span) for span in rest[name]) for name in ("modes", "failsafes")}
        rest["said"] = tuple(Said(*said) for said in rest["said"])
        return cls(**arrays, **rest)
