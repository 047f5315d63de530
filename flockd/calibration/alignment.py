"""How a camera is turned in the body, and by how much its time differs from the autopilot's, from both their turns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from flockd.calibration.errors import CalibrationError
from flockd.calibration.least_squares import Normal, minimise
from flockd.calibration.turns import CameraTurn, best_rotation
from flockd.geometry.rotations import rotation_from_vector
from flockd.messages import BoolArray, FloatArray

MIN_TURNS = 30
_SCAN_S = 0.01
_ROUNDS = 8
_TIME_STEP_S = 1e-3
_SIGMA_DEG, _SIGMA_S = 0.5, 0.01
"""What is more uncertain than this is not known."""
_MOST_RMS_SHARE = 0.3
"""Of the turns themselves: more left over than this, and both have nothing to do with each other."""
_LONGEST_GAP = 3.0
"""Attitudes farther apart than this times their median are not interpolated between."""
_AXES = ("rolled", "pitched", "yawed")


@dataclass(frozen=True, eq=False)
class Attitudes:
    """What the autopilot said of the vehicle's attitude: times (n,) that grow, and (n, 3, 3) ``R_ned_body``."""

    times_s: FloatArray
    rotations: FloatArray

    def at(self, times_s: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(m, 3, 3) attitudes at these times (m,), and a mask (m,) of those that lie between two near ones.

        Cubic between neighbours, with rates from those beyond them.
        """
        steps_s = np.diff(self.times_s)
        turns = logs(np.swapaxes(self.rotations[:-1], 1, 2) @ self.rotations[1:])
        rates = turns / steps_s[:, None]
        weights = steps_s[:, None]
        inner = (rates[:-1] * weights[1:] + rates[1:] * weights[:-1]) / (weights[:-1] + weights[1:])
        at_knots = np.concatenate([rates[:1], inner, rates[-1:]])
        index = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(steps_s) - 1)
        span = steps_s[index]
        s = ((times_s - self.times_s[index]) / span)[:, None]
        turn = (
            (s**3 - 2 * s**2 + s) * at_knots[index] * span[:, None]
            + (3 * s**2 - 2 * s**3) * turns[index]
            + (s**3 - s**2) * at_knots[index + 1] * span[:, None]
        )
        inside = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        inside &= span <= _LONGEST_GAP * float(np.median(steps_s))
        return self.rotations[index] @ exponentials(turn), inside


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a camera is turned, and when it took its pictures."""

    R_body_camera: FloatArray
    sigma_deg: float
    """Standard deviation about the body axis that is known worst: what noise alone leaves open."""
    time_offset_s: float
    """Added to a picture's time, the autopilot's time of the same moment."""
    sigma_s: float
    rms_deg: float
    """Of what is left over of the turns, without outliers."""
    turns: int


def align(turns: Sequence[CameraTurn], attitudes: Attitudes, max_offset_s: float) -> Alignment:
    """The rotation and the offset for which the camera's turns are the vehicle's.

    Raises CalibrationError where there are too few turns, where both contradict each other, and where the vehicle
    turned too little, or about one axis only, to tell.
    """
    problem = _Problem.of(turns, attitudes, max_offset_s)
    offset_s, weights = problem.scan(max_offset_s)
    state = _State(best_rotation(problem.vehicle(offset_s), problem.camera, weights), offset_s)
    for _ in range(_ROUNDS):
        solution = minimise(state, partial(problem.normal, weights=weights), _move)
        state = solution.state
        weights = _weights(problem.residuals(state))
    left = problem.residuals(state)
    good = weights > 0.2
    rms = float(np.sqrt((left[good] ** 2).sum(axis=1).mean()))
    size = float(np.sqrt((problem.vehicle(state.offset_s)[good] ** 2).sum(axis=1).mean()))
    if rms > _MOST_RMS_SHARE * size:
        raise CalibrationError(
            f"the camera's turns and the vehicle's have nothing to do with each other: {math.degrees(rms):.2f} of "
            f"{math.degrees(size):.2f} degrees are left over; turn the drone faster, before something that stands still"
        )
    sigma = solution.sigma(3 * int(good.sum()), 4)
    found = Alignment(
        R_body_camera=state.rotation,
        sigma_deg=math.degrees(float(sigma[:3].max())),
        time_offset_s=state.offset_s,
        sigma_s=float(sigma[3]),
        rms_deg=math.degrees(rms),
        turns=int(good.sum()),
    )
    _check_known(found, problem, abs(state.offset_s) >= max_offset_s)
    return found


def _check_known(found: Alignment, problem: _Problem, at_limit: bool) -> None:
    if not found.sigma_deg < _SIGMA_DEG:
        spread = np.abs(problem.vehicle(found.time_offset_s)).mean(axis=0)
        most = _AXES[int(np.argmax(spread))]
        others = " and ".join(axis.removesuffix("ed") for axis in _AXES if axis != most)
        raise CalibrationError(
            f"the drone {most} and hardly did anything else, so the camera's turn about that axis is known to "
            f"{found.sigma_deg:.1f} degrees only; {others} it too"
        )
    if not found.sigma_s < _SIGMA_S or at_limit:
        raise CalibrationError(
            f"the time offset is known to {1000 * found.sigma_s:.0f} ms only, as the drone turned too evenly or the "
            "offset is larger than was looked for; turn it back and forth, or raise --max-offset"
        )


@dataclass(frozen=True, eq=False)
class _State:
    rotation: FloatArray
    offset_s: float


@dataclass(frozen=True, eq=False)
class _Problem:
    attitudes: Attitudes
    starts_s: FloatArray
    ends_s: FloatArray
    camera: FloatArray
    """(n, 3) rotation vectors of the camera's turns, in its axes."""

    @classmethod
    def of(cls, turns: Sequence[CameraTurn], attitudes: Attitudes, max_offset_s: float) -> _Problem:
        """Of those turns that attitudes are known for, whatever the offset."""
        starts, ends = (np.array([getattr(turn, name) for turn in turns]) for name in ("start_s", "end_s"))
        known = np.ones(len(turns), np.bool_)
        if len(attitudes.times_s) < MIN_TURNS or len(turns) < MIN_TURNS:
            known[:] = False
        for times in (starts, ends) if known.any() else ():
            for offset in (-max_offset_s, 0.0, max_offset_s):
                known &= attitudes.at(times + offset)[1]
        if known.sum() < MIN_TURNS:
            raise CalibrationError(
                f"{int(known.sum())} turns with attitudes are too few, {MIN_TURNS} are needed; record for longer"
            )
        vectors = logs(np.array([turn.rotation for turn in turns]))
        return cls(attitudes, starts[known], ends[known], vectors[known])

    def vehicle(self, offset_s: float) -> FloatArray:
        """(n, 3) rotation vectors of the vehicle's turns meanwhile, in its axes."""
        first, _ = self.attitudes.at(self.starts_s + offset_s)
        second, _ = self.attitudes.at(self.ends_s + offset_s)
        return logs(np.swapaxes(first, 1, 2) @ second)

    def scan(self, max_offset_s: float) -> tuple[float, FloatArray]:
        """The offset that leaves least, whatever the rotation, and the weights (n,) of the turns there."""
        best = (math.inf, 0.0, np.ones(len(self.camera)))
        for offset_s in np.arange(-max_offset_s, max_offset_s + _SCAN_S / 2, _SCAN_S):
            vehicle, weights = self.vehicle(float(offset_s)), np.ones(len(self.camera))
            for _ in range(3):
                left = vehicle - self.camera @ best_rotation(vehicle, self.camera, weights).T
                weights = _weights(left)
            cost = float(np.median(np.linalg.norm(left, axis=1)))
            if cost < best[0]:
                best = (cost, float(offset_s), weights)
        return best[1], best[2]

    def residuals(self, state: _State) -> FloatArray:
        """(n, 3) radians."""
        return self.vehicle(state.offset_s) - self.camera @ state.rotation.T

    def normal(self, state: _State, weights: FloatArray) -> Normal:
        scale = np.sqrt(weights)[:, None]
        left = (self.residuals(state) * scale).ravel()
        turned = self.camera @ state.rotation.T
        derivative = np.zeros((len(turned), 3, 4))
        x, y, z = turned.T
        derivative[:, 0, 1], derivative[:, 0, 2] = -z, y
        derivative[:, 1, 0], derivative[:, 1, 2] = z, -x
        derivative[:, 2, 0], derivative[:, 2, 1] = -y, x
        later, sooner = self.vehicle(state.offset_s + _TIME_STEP_S), self.vehicle(state.offset_s - _TIME_STEP_S)
        derivative[:, :, 3] = (later - sooner) / (2 * _TIME_STEP_S)
        J = (derivative * scale[:, :, None]).reshape(-1, 4)
        return Normal(float(left @ left), J.T @ left, J.T @ J)


def _move(state: _State, step: FloatArray) -> _State:
    return _State(rotation_from_vector(step[:3]) @ state.rotation, state.offset_s + float(step[3]))


def _weights(left: FloatArray) -> FloatArray:
    """Tukey's: what is far off counts nothing."""
    size = np.linalg.norm(left, axis=1)
    scale = 6.0 * max(float(np.median(size)), 1e-9)
    weights: FloatArray = np.maximum(1.0 - (size / scale) ** 2, 0.0) ** 2
    return weights


def logs(rotations: FloatArray) -> FloatArray:
    """(n, 3) rotation vectors of rotations (n, 3, 3) by less than half a turn."""
    R = rotations
    twice_sine = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine, cosine = np.linalg.norm(twice_sine, axis=1) / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    factor = np.where(sine > 1e-12, angle / np.maximum(2 * sine, 1e-300), 0.5)
    vectors: FloatArray = twice_sine * factor[:, None]
    return vectors


def exponentials(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) rotations by rotation vectors (n, 3)."""
    angle = np.linalg.norm(vectors, axis=1)
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    sine = np.where(small, 1.0, np.sin(safe) / safe)
    one_minus_cosine = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    found: FloatArray = np.eye(3) + sine[:, None, None] * cross + one_minus_cosine[:, None, None] * (cross @ cross)
    return found
