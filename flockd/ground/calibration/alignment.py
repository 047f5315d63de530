"""How a camera is turned in the body, and by how much its time differs from the autopilot's, from both their turns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.rigid_fit import fit_rotation
from flockd.flight.geometry.robust.kernels import Tukey
from flockd.flight.geometry.robust.reweighting import reweighted, robust_rotation
from flockd.flight.geometry.robust.solver import LevenbergMarquardt, NormalEquations, Problem, Solution
from flockd.flight.geometry.rotations import rotation_from_vector, vector_from_rotation
from flockd.ground.calibration.errors import CalibrationError
from flockd.ground.calibration.turns import CameraTurn

MIN_TURNS = 30
_AXES = ("rolled", "pitched", "yawed")


_SCAN_STEP_S = 0.01
"""Between offsets that are tried as starts."""
_MAX_ROUNDS = 8
_WEIGHT_TOLERANCE = 1e-3
"""Fits with new weights end where no weight changes by more."""
_CHAIN_S = 0.4
"""Turns are compared over about this long."""
_INLIER_WEIGHT = 0.2
"""Weight above which a turn counts as one that fits."""
_DIFFERENCE_STEP_S = 1e-3
"""Step of the derivative by the offset."""
_MAX_SIGMA_DEG, _MAX_SIGMA_S = 0.5, 0.01
"""What is more uncertain than this is not known."""
_MAX_RESIDUAL = 0.3
"""Share of the turns themselves: more left over than this, and both have nothing to do with each other."""
_MAX_GAP = 3.0
"""Attitudes farther apart than this times their median are not interpolated between."""


@dataclass(frozen=True, eq=False)
class Attitudes:
    """What the autopilot said of the vehicle's attitude: times (n,) that grow, and (n, 3, 3) ``R_ned_body``."""

    times_s: FloatArray
    rotations: FloatArray

    @cached_property
    def _spline(self) -> CubicSpline:
        """Natural cubic splines through each entry of the matrices."""
        return CubicSpline(self.times_s, self.rotations, bc_type="natural")

    def at(self, times_s: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(m, 3, 3) attitudes at these times (m,), and a mask (m,) of those that lie between two near ones."""
        steps = np.diff(self.times_s)
        index = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(steps) - 1)
        u, _, vt = np.linalg.svd(self._spline(times_s))
        inside = (times_s >= self.times_s[0]) & (times_s <= self.times_s[-1])
        inside &= steps[index] <= _MAX_GAP * float(np.median(steps))
        return u @ vt, inside


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a camera is turned, and when it took its images."""

    R_body_camera: FloatArray
    sigma_deg: float
    """Standard deviation about the body axis that is known worst: what noise alone leaves open."""
    time_offset_s: float
    """Added to an image's time, the autopilot's time of the same moment."""
    sigma_s: float
    rms_deg: float
    """Root mean square of the turns' residuals, without outliers."""
    turns: int


def align(turns: Sequence[CameraTurn], attitudes: Attitudes, max_offset_s: float) -> Alignment:
    """The rotation and the offset for which the camera's turns are the vehicle's.

    Raises CalibrationError where there are too few turns, where both contradict each other, and where the vehicle
    turned too little, or about one axis only, to tell.
    """
    each = _Turns.of(turns, attitudes, max_offset_s)
    offset_s, weights = each.scan(max_offset_s)
    start = _State(fit_rotation(each.camera, each.vehicle(offset_s), weights), offset_s)
    solution, weights = _fit(each, start, weights)
    chains = _chained([turn for turn, weight in zip(each.turns, weights, strict=True) if weight > _INLIER_WEIGHT])
    problem = _Turns.of(chains, attitudes, max_offset_s)
    solution, weights = _fit(problem, solution.state, np.ones(len(problem.turns)))
    state = solution.state
    left = problem.residuals(state)
    good = weights > _INLIER_WEIGHT
    rms = float(np.sqrt((left[good] ** 2).sum(axis=1).mean()))
    size = float(np.sqrt((problem.vehicle(state.offset_s)[good] ** 2).sum(axis=1).mean()))
    if rms > _MAX_RESIDUAL * size:
        raise CalibrationError(
            f"the camera's turns and the vehicle's have nothing to do with each other: {math.degrees(rms):.2f} of "
            f"{math.degrees(size):.2f} degrees are left over; turn the drone faster, before something that stands still"
        )
    shared = max(sum(turn.end_s - turn.start_s for turn in chains) / (chains[-1].end_s - chains[0].start_s), 1.0)
    sigma = math.sqrt(shared) * solution.sigma(
        3 * int(good.sum()), 4
    )  # chains that overlap say less than they are many
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


def _fit(turns: _Turns, start: _State, weights: FloatArray) -> tuple[Solution[_State], FloatArray]:
    """From a start and weights (n,): the last fit, and the weights of what it leaves over."""
    return reweighted(
        lambda weights, before: LevenbergMarquardt().minimise(
            _Alignment(turns, weights), before.state if before else start
        ),
        lambda solution: np.linalg.norm(turns.residuals(solution.state), axis=1),
        _tukey,
        weights,
        rounds=_MAX_ROUNDS,
        settled=_WEIGHT_TOLERANCE,
    )


def _chained(turns: Sequence[CameraTurn]) -> list[CameraTurn]:
    """From each turn on, as many as take nearest to `_CHAIN_S` together, as one.

    The noise of a short turn is as large as that of a long one; and where attitudes are interpolated it is smaller,
    which would draw short turns there, whatever the offset.
    """
    found = []
    for first, turn in enumerate(turns):
        rotation, end_s = turn.rotation, turn.end_s
        for after in turns[first + 1 :]:
            if after.start_s != end_s or end_s - turn.start_s > _CHAIN_S - 0.5 * (after.end_s - after.start_s):
                break
            rotation, end_s = rotation @ after.rotation, after.end_s
        found.append(CameraTurn(turn.start_s, end_s, rotation))
    return found


def _check_known(found: Alignment, problem: _Turns, at_limit: bool) -> None:
    if not found.sigma_deg < _MAX_SIGMA_DEG:
        spread = np.abs(problem.vehicle(found.time_offset_s)).mean(axis=0)
        most = _AXES[int(np.argmax(spread))]
        others = " and ".join(axis.removesuffix("ed") for axis in _AXES if axis != most)
        raise CalibrationError(
            f"the camera's turn in the body is known to {found.sigma_deg:.1f} degrees only, as the drone mostly {most};"
            f" {others} it as much, and for longer"
        )
    if not found.sigma_s < _MAX_SIGMA_S or at_limit:
        raise CalibrationError(
            f"the time offset is known to {1000 * found.sigma_s:.0f} ms only, as the drone turned too evenly or the "
            "offset is larger than --max-offset; turn it back and forth, or raise --max-offset"
        )


@dataclass(frozen=True, eq=False)
class _State:
    rotation: FloatArray
    offset_s: float


@dataclass(frozen=True, eq=False)
class _Turns:
    turns: Sequence[CameraTurn]
    attitudes: Attitudes
    starts_s: FloatArray
    ends_s: FloatArray
    camera: FloatArray
    """(n, 3) rotation vectors of the camera's turns, in its axes."""

    @classmethod
    def of(cls, turns: Sequence[CameraTurn], attitudes: Attitudes, max_offset_s: float) -> _Turns:
        """The turns for which attitudes are known, whatever the offset."""
        starts, ends = (np.array([getattr(turn, name) for turn in turns]) for name in ("start_s", "end_s"))
        known = np.ones(len(turns), np.bool_)
        if min(len(attitudes.times_s), len(turns)) >= MIN_TURNS:
            for times in (starts, ends):
                for offset in (-max_offset_s, 0.0, max_offset_s):
                    known &= attitudes.at(times + offset)[1]
        count = min(int(known.sum()), len(attitudes.times_s))
        if count < MIN_TURNS:
            raise CalibrationError(
                f"{count} turns with attitudes are too few, {MIN_TURNS} are needed; record for longer"
            )
        vectors = vector_from_rotation(np.array([turn.rotation for turn in turns]))
        used = [turn for turn, one in zip(turns, known, strict=True) if one]
        return cls(used, attitudes, starts[known], ends[known], vectors[known])

    def vehicle(self, offset_s: float) -> FloatArray:
        """(n, 3) rotation vectors of the vehicle's turns meanwhile, in its axes."""
        first, _ = self.attitudes.at(self.starts_s + offset_s)
        second, _ = self.attitudes.at(self.ends_s + offset_s)
        return vector_from_rotation(np.swapaxes(first, 1, 2) @ second)

    def scan(self, max_offset_s: float) -> tuple[float, FloatArray]:
        """The offset that leaves least, whatever the rotation, and the weights (n,) of the turns there."""
        best = (math.inf, 0.0, np.ones(len(self.camera)))
        for offset_s in np.arange(-max_offset_s, max_offset_s + _SCAN_STEP_S / 2, _SCAN_STEP_S):
            vehicle = self.vehicle(float(offset_s))
            _, left, weights = robust_rotation(self.camera, vehicle, _tukey, rounds=3)
            cost = float(np.median(left))
            if cost < best[0]:
                best = (cost, float(offset_s), weights)
        return best[1], best[2]

    def residuals(self, state: _State) -> FloatArray:
        """(n, 3) radians."""
        return self.vehicle(state.offset_s) - self.camera @ state.rotation.T


@dataclass(frozen=True, eq=False)
class _Alignment(Problem[_State]):
    """Four parameters: the camera's rotation vector in the body, and the offset in seconds."""

    turns: _Turns
    weights: FloatArray

    def linearise(self, state: _State) -> NormalEquations:
        turned = self.turns.camera @ state.rotation.T
        jacobian = np.zeros((len(turned), 3, 4))
        x, y, z = turned.T
        jacobian[:, 0, 1], jacobian[:, 0, 2] = -z, y
        jacobian[:, 1, 0], jacobian[:, 1, 2] = z, -x
        jacobian[:, 2, 0], jacobian[:, 2, 1] = -y, x
        later, sooner = (self.turns.vehicle(state.offset_s + sign * _DIFFERENCE_STEP_S) for sign in (1.0, -1.0))
        jacobian[:, :, 3] = (later - sooner) / (2 * _DIFFERENCE_STEP_S)
        residuals = self.turns.residuals(state).ravel()
        return NormalEquations.of(residuals, jacobian.reshape(-1, 4), np.repeat(self.weights, 3))

    def move(self, state: _State, step: FloatArray) -> _State:
        return _State(rotation_from_vector(step[:3]) @ state.rotation, state.offset_s + float(step[3]))


def _tukey(left: FloatArray) -> Tukey:
    """For residuals (n,): what is far off counts nothing."""
    return Tukey(6.0 * max(float(np.median(left)), 1e-9))
