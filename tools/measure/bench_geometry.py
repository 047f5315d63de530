"""Rigid motions between paired points: ours, the paper's, and OpenCV's, on the same pairs and one thread.

OMP_NUM_THREADS=1 python -m tools.measure.bench_geometry        # all cases, 30 draws each: some minutes

Milliseconds are the median of the best of three runs of each draw; degrees and centimetres the median and the 99th
percentile; a failure is an answer off by more than 1 degree or 5 cm (for the cases with large errors, 3 degrees or 20
cm), or none.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.messages import FloatArray
from flockd.flight.geometry import RigidTransform, ransac_rigid

NOISE_M = 0.05
FAILED_DEG, FAILED_M = 1.0, 0.05


@dataclass(frozen=True)
class Case:
    """Pairs of one kind."""

    name: str
    pairs: int
    outliers: float = 0.0
    second_motion: float = 0.0
    """Share of pairs that move otherwise, together."""
    stereo: bool = False
    """Errors grow with the range's square, from 2 to 30 m."""
    turn_deg: float = 10.0
    flat: bool = False
    """All on a plane, but for 2 %."""
    extent_m: float = 0.0
    """Of an object 6 m away; 0: points all around, from 2 to 15 m."""
    allowed: float = 1.0
    """What counts as a failure, times this."""


CASES = (
    Case("300, 0 % outliers", 300),
    Case("300, 30 % outliers", 300, 0.3),
    Case("300, 60 % outliers", 300, 0.6, allowed=4.0),
    Case("5000, 0 % outliers", 5000),
    Case("5000, 30 % outliers", 5000, 0.3),
    Case("5000, 60 % outliers", 5000, 0.6),
    Case("5000, 90 % outliers", 5000, 0.9),
    Case("50000, 30 % outliers", 50_000, 0.3),
    Case("50000, 60 % outliers", 50_000, 0.6),
    Case("5000, 40 % of another motion", 5000, second_motion=0.4),
    Case("5000, errors of stereo, 30 %", 5000, 0.3, stereo=True, allowed=3.0),
    Case("5000, turned by 150 degrees, 30 %", 5000, 0.3, turn_deg=150.0),
    Case("5000, turned by 0.2 degrees, 30 %", 5000, 0.3, turn_deg=0.2),
    Case("5000, nearly a plane, 30 %", 5000, 0.3, flat=True),
    Case("100 on an object of 0.6 m, 20 %", 100, 0.2, extent_m=0.6, allowed=8.0),
)


Draw = tuple[FloatArray, FloatArray, RigidTransform]
"""Pairs, source and target (n, 3), and the motion between them."""


def draw(case: Case, seed: int) -> Draw:
    """Pairs of a case."""
    random = np.random.default_rng(seed)
    source = _points(case, random)
    axis = random.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(case.turn_deg) * axis / np.linalg.norm(axis))
    motion = RigidTransform(turn.as_matrix(), random.normal(0.0, 0.3, 3))
    noise = np.full((case.pairs, 1), NOISE_M if not case.extent_m else 0.02)
    if case.stereo:
        noise = 0.002 * np.linalg.norm(source, axis=1, keepdims=True) ** 2
    target = motion.apply(source) + random.normal(size=source.shape) * noise
    other = random.random(case.pairs) < case.second_motion
    second = RigidTransform(Rotation.from_rotvec(random.normal(0.0, 0.1, 3)).as_matrix(), random.normal(0.0, 0.5, 3))
    target[other] = second.apply(source[other]) + random.normal(size=(int(other.sum()), 3)) * noise[other]
    wrong = random.random(case.pairs) < case.outliers
    reach_m = case.extent_m or 3.0
    target[wrong] += random.uniform(-reach_m, reach_m, (int(wrong.sum()), 3))
    return source, target, motion


def _points(case: Case, random: np.random.Generator) -> FloatArray:
    if case.extent_m:
        half_m = case.extent_m / 2.0
        return np.array([6.0, 0.0, 0.0]) + random.uniform(-half_m, half_m, (case.pairs, 3))
    points = random.normal(size=(case.pairs, 3))
    points *= random.uniform(2.0, 30.0 if case.stereo else 15.0, (case.pairs, 1)) / np.linalg.norm(
        points, axis=1, keepdims=True
    )
    if case.flat:
        on_it = random.random(case.pairs) > 0.02
        points[on_it, 2] = 3.0
    return points


def _opencv(source: FloatArray, target: FloatArray, noise_m: float) -> RigidTransform:
    found, affine, _ = cv2.estimateAffine3D(source, target, ransacThreshold=3.0 * noise_m)
    if not found:
        raise ValueError("no affine motion")
    u, _, vt = np.linalg.svd(affine[:, :3])
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    middle = source.mean(axis=0)
    return RigidTransform(rotation, affine[:, :3] @ middle + affine[:, 3] - rotation @ middle)


METHODS: dict[str, Callable[[FloatArray, FloatArray, float], RigidTransform]] = {
    "Algorithm 1": lambda source, target, _: ransac_rigid(source, target, min_inlier_ratio=0.05).transform,
    "OpenCV affine": _opencv,
}
"""From pairs and the size of their errors, m, to a motion."""


def measured(case: Case, method: str, draws: int) -> dict[str, Any]:
    """One method on the draws of a case: `ms`, `degrees` and `cm` (median and 99th percentile), `failures`."""
    ms, degrees, cm, failures = [], [], [], 0
    noise_m = 0.02 if case.extent_m else 0.2 if case.stereo else NOISE_M
    for seed in range(draws):
        source, target, motion = draw(case, seed)
        middle = source.mean(axis=0)[None]
        best_s, off_deg, off_m = np.inf, np.inf, np.inf
        for _ in range(3):
            start = time.perf_counter()
            try:
                found = METHODS[method](source, target, noise_m)
            except ValueError:
                best_s = min(best_s, time.perf_counter() - start)
                continue
            best_s = min(best_s, time.perf_counter() - start)
            off_deg = float(np.degrees(Rotation.from_matrix(found.rotation @ motion.rotation.T).magnitude()))
            off_m = float(np.linalg.norm(found.apply(middle) - motion.apply(middle)))
        ms.append(1e3 * best_s)
        degrees.append(off_deg)
        cm.append(100.0 * off_m)
        failures += not (off_deg < case.allowed * FAILED_DEG and off_m < case.allowed * FAILED_M)
    known = {"degrees": degrees, "cm": cm}
    off = {name: (np.median(of), np.percentile(of, 99, method="lower")) for name, of in known.items()}
    return {"case": case.name, "method": method, "ms": np.median(ms), **off, "failures": failures}


def main() -> None:
    """Prints JSON, a row for each case and method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=30)
    draws = parser.parse_args().draws
    cv2.setNumThreads(1)
    print(json.dumps([measured(case, method, draws) for case in CASES for method in METHODS], indent=1))


if __name__ == "__main__":
    main()
