"""A drone's size from photographs of it at known distances: distance times apparent size, robustly averaged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from flockd.core.config.perception import MAX_DRONE_SIZE_M, MIN_DRONE_SIZE_M
from flockd.core.messages import FloatArray
from flockd.ground.calibration.board import CalibrationError

MAX_DISTANCE_M = 200.0
"""Nobody measures more with a tape, and no network detects a drone there."""
MIN_PICTURES = 4
"""Fewer cannot show that one of them is wrong."""
AGREEMENT = 0.2
"""Difference of log sizes within which two pictures agree: what views of one drone differ by, edge-on ones included."""
MAX_DROPPED = 1 / 3
"""Share of the pictures: where more contradict the others, it is not known which are right."""
VIEW_SIGMA = 0.04
"""Standard deviation of the log apparent size from one view to another, beside what the network says of its own error:
on rendered drones of families that the network never saw, its median absolute value is 4 %."""
TAPE_SIGMA_M = 0.02
"""Standard deviation of a distance by a tape, from the lens to the drone's middle."""
MAX_SIGMA = 0.05
"""Standard deviation of the result as a share of it: with more, too little is known to fly with."""
NAMED = 3
"""How many pictures that contradict each other are named."""


@dataclass(frozen=True)
class SizeCandidate:
    """One detection in a photograph: the drone, or something else that was taken for one."""

    size_m: float
    """The distance times the apparent size, if it is the drone."""
    apparent_sigma: float
    """Standard deviation of the log apparent size, as the network says."""
    probability: float


@dataclass(frozen=True)
class Photograph:
    """One picture of the drone."""

    name: str
    distance_m: float
    """Measured, from the lens to the drone's middle."""
    candidates: tuple[SizeCandidate, ...]


@dataclass(frozen=True)
class SizedPhotograph:
    """What one picture says."""

    name: str
    distance_m: float
    size_m: float
    sigma: float
    """Standard deviation of the log size by this picture alone."""
    used: bool
    """False: it contradicts the others."""

    def residual(self, size_m: float) -> float:
        """Error of the range that this picture gives with a size, as a share of the distance."""
        return size_m / self.size_m - 1.0


@dataclass(frozen=True)
class DroneSize:
    """The drone's size, and what it was found from."""

    size_m: float
    sigma_m: float
    """Standard deviation."""
    pictures: tuple[SizedPhotograph, ...]
    missed: tuple[str, ...]
    """Pictures in which nothing was detected."""

    def fragment(self, source: str) -> str:
        """YAML for a drone's file; ``source``: the command's pictures, for the comment."""
        used = sum(one.used for one in self.pictures)
        today = datetime.now(UTC).date().isoformat()
        return (
            f"# Written by `flockd calibrate drone` on {today} from {used} pictures ({source}).\n"
            "# Copy both keys to `perception` in your drone's file, then run `flockd config check` on that.\n"
            f"perception:\n  drone_size_m: {self.size_m:.4f}\n  drone_size_sigma_m: {self.sigma_m:.4f}\n"
        )

    def as_json(self) -> dict[str, Any]:
        """Numbers for machines."""
        return {
            "drone_size_m": round(self.size_m, 4),
            "drone_size_sigma_m": round(self.sigma_m, 4),
            "pictures": [
                {
                    "file": one.name,
                    "distance_m": one.distance_m,
                    "size_m": round(one.size_m, 4),
                    "residual": round(one.residual(self.size_m), 4),
                    "used": one.used,
                }
                for one in self.pictures
            ],
            "missed": list(self.missed),
        }


def fit_size(photographs: Sequence[Photograph]) -> DroneSize:
    """The size that most photographs agree on. Raises CalibrationError where they are too few or contradict each other.

    Of several detections in a picture the one that agrees best with the other pictures is taken. The result is the mean
    log size weighted by the inverse variances; where the pictures differ by more than their deviations say, the
    result's is enlarged likewise (Birge 1932).
    """
    seen = [one for one in photographs if one.candidates]
    missed = tuple(one.name for one in photographs if not one.candidates)
    if len(seen) < MIN_PICTURES:
        nothing = f", and none is detected in {len(missed)} more" if missed else ""
        raise CalibrationError(
            f"the drone is detected in {len(seen)} pictures{nothing}; take at least {MIN_PICTURES} in which it is "
            "alone, sharp and at least 30 pixels wide"
        )
    centre = _consensus(seen)
    sized = [_sized(one, centre) for one in seen]
    _refuse_contradictions(sized)
    used = [one for one in sized if one.used]
    logs = np.log([one.size_m for one in used])
    weights = np.array([one.sigma for one in used]) ** -2.0
    mean = float(weights @ logs / weights.sum())
    chi_square = float(weights @ (logs - mean) ** 2)
    sigma = math.sqrt(max(1.0, chi_square / (len(used) - 1)) / weights.sum())
    size_m = math.exp(mean)
    if sigma > MAX_SIGMA:
        raise CalibrationError(
            f"the size is {size_m:.3f} m +- {100 * sigma:.0f} %, which is too uncertain to fly with; take more "
            "pictures, from other sides and nearer"
        )
    if not MIN_DRONE_SIZE_M <= size_m <= MAX_DRONE_SIZE_M:
        raise CalibrationError(
            f"a size of {size_m:.3f} m is no drone's ({MIN_DRONE_SIZE_M:g} to {MAX_DRONE_SIZE_M:g} m); check the "
            "distances, which are in metres, and the field of view"
        )
    return DroneSize(size_m, size_m * sigma, tuple(sized), missed)


def _consensus(seen: Sequence[Photograph]) -> float:
    """The log size that a candidate of the most pictures agrees with; of equal ones the more probable."""
    sizes = [[(math.log(c.size_m), c.probability) for c in one.candidates] for one in seen]

    def support(centre: float) -> tuple[int, float]:
        near = [max((p for s, p in one if abs(s - centre) <= AGREEMENT), default=0.0) for one in sizes]
        return sum(p > 0 for p in near), sum(near)

    best = max((size for one in sizes for size, _ in one), key=support)
    near = [size for one in sizes for size, _ in one if abs(size - best) <= AGREEMENT]
    return float(np.median(near))


def _sized(one: Photograph, centre: float) -> SizedPhotograph:
    chosen = min(one.candidates, key=lambda candidate: abs(math.log(candidate.size_m) - centre))
    sigma = math.hypot(chosen.apparent_sigma, VIEW_SIGMA, TAPE_SIGMA_M / one.distance_m)
    agrees = abs(math.log(chosen.size_m) - centre) <= AGREEMENT
    return SizedPhotograph(one.name, one.distance_m, chosen.size_m, sigma, agrees)


def _refuse_contradictions(sized: Sequence[SizedPhotograph]) -> None:
    dropped = [one for one in sized if not one.used]
    used = len(sized) - len(dropped)
    if len(dropped) <= MAX_DROPPED * len(sized) and used >= MIN_PICTURES:
        return
    sizes: FloatArray = np.array([one.size_m for one in sized if one.used])
    others = ", ".join(f"{one.size_m:.2f} m by {one.name} at {one.distance_m:g} m" for one in dropped[:NAMED])
    more = f" and {len(dropped) - NAMED} more" if len(dropped) > NAMED else ""
    raise CalibrationError(
        f"the pictures contradict each other: the drone's size is {np.median(sizes):.2f} m by {used} of them, and "
        f"{others}{more}; check the distances, and that nothing else in the pictures looks like a drone"
    )
