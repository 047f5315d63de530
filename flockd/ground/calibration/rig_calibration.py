"""Calibrates a rig by a flight: mounting, time offset and focal length of each camera, with covariance.

An error-state Kalman filter. It compares the motion of each camera between two images (`camera_motion`) with the
autopilot's motion of the body. The camera's rotation is the body's in other axes (hand-eye calibration: Tsai and Lenz
1989), which determines the mounting about the axes across the rotation. So does the direction of the displacement, as
far as the autopilot's velocity is right. The time offset follows from rates of turn (Li and Mourikis, "Online temporal
calibration for camera-IMU systems", IJRR 2014; Qin and Shen, IROS 2018), and the focal length from the size of
rotations. See also Kelly and Sukhatme, "Visual-inertial sensor fusion: localization, mapping and sensor-to-sensor
self-calibration", IJRR 2011. Parameters that a flight does not show keep their initial uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flockd.core.messages import FloatArray, VehicleState
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.geometry.rig import Rig, RigCamera
from flockd.flight.geometry.rotations import cross_matrix, rotation_from_vector, vector_from_rotation
from flockd.flight.geometry.transform import RigidTransform
from flockd.flight.pilot.camera_agreement import moves_otherwise
from flockd.ground.calibration.camera_motion import CameraMotion, camera_motion

PRIOR_TURN_RAD, PRIOR_OFFSET_S, PRIOR_FOCAL = math.radians(4.0), 0.06, 0.04
"""Initial standard deviations: each axis of a mounting, a time offset, the logarithm of a focal length."""
_TURN_SIGMA_RAD, _LEAST_TURN_RAD, _TURN_GAIN = math.radians(0.15), math.radians(0.05), 0.1
"""Standard deviation of the autopilot's rotation between two images, each axis: initial, and least; and the share by
which it is learnt in each update, from the cameras' agreement (expectation maximisation). If it were too small, jitter
of the attitude would look like rotations of the body and give wrong mountings."""
_VELOCITY_SIGMA_M_S, _VELOCITY_TIME_S = 0.2, 10.0
"""Standard deviation of the persistent error of the autopilot's velocity, each axis (PX4's: 0.15 m/s for seconds)."""
_VELOCITY_NOISE_M_S = 0.1
"""Added for each pair of images, as the flight between them is not known."""
_WAY_SIGMA = 0.03
"""Of the way that a camera sees, share of it, each axis: a network's flow has the direction off by 0.4 to 3.9 degrees
(standard deviations of cameras in realistic flights, beside the truth), for seconds at a time, where its matches claim
0.2. With 0.2, focal lengths and mountings were corrected that were right."""
_READOUT_S = 0.02
"""Of all cameras alike: the time over an image's width, and over its height, in which rows are read one after the
other; 0 for a global shutter. Where the rate of turn changes, that makes turns about other axes of turns, and focal
lengths (E. Ringaby and P.-E. Forssen, "Efficient video rectification and stabilisation for cell-phones", IJCV 2012)."""
_UNKNOWN_M_S = 10.0
"""The same where the autopilot says no velocity."""
_MAX_INTERVAL_S = 2.0
_EVERY_S = 0.3
"""Shortest interval; of faster steps some are left out, because their rotations are small and each takes 5 ms of a core
for four cameras."""
_ROUNDS = 2
"""Number of iterations, each linearised at the last motion of the body. A third changed no number by 0.003 sigma."""
_FIT_GAIN = 0.1
_MAX_MISFIT = 16.0
"""Largest normalised square of a camera's motion that is used; a larger one followed a moving object."""
_MAX_UNEXPECTED = 2.8
"""The same against the result of the whole flight: 99 % are below (chi-square with 6 degrees of freedom)."""
_MAX_INFLATION = 9.0
"""Largest factor between a camera's errors and its own covariance."""
_AGREEMENT_GAIN, _AGREES = 0.125, 0.5
"""Share of one motion in whether a camera's last ones agree with the body's (1) or not (-1), and from which on it does:
after three seconds in which all did, or none. In flights with mountings up to 20 degrees off all do."""
_MOVES_M, _MOVES_RAD = 0.2, math.radians(1.0)
"""Least displacement and rotation of the body at which agreement is judged: a person who walks in front of a drone on
the ground must not make a camera count as exchanged."""
WORTH_TURN_RAD, WORTH_OFFSET_S, WORTH_FOCAL = math.radians(0.5), 0.01, 0.01
"""Smallest differences that are worth a warning: half a degree moves a drone at 10 m by 0.09 m, and 1 % changes a range
by 1 %."""
_SURE, _SURE_OF_TURN = 16.0, 22.06
"""Squares of four standard deviations of one number, and what as few of three numbers together exceed (1 in 15,800): it
is asked of every camera before every flight."""
_SIZE, _SHARED = 5, 5
_TURN, _OFFSET, _FOCAL = slice(0, 3), 3, 4
_LASTING = np.diag(np.array([math.radians(0.1)] * 3 + [1.5e-3, 3e-3]) ** 2)
"""Beside the filter's own covariance: a network's flow and a rate of turn err in one direction for whole flights. By
sight in the simulator with gusts of 0.3 m/s 0.05 degrees an axis, 1.7 ms and 0.06 %, root mean
squares of 16 cameras in two worlds; with real cameras more is to be expected."""


@dataclass(frozen=True, eq=False)
class CameraDeviation:
    """Deviation of a camera from its configuration, by its images in a flight."""

    camera: str
    turn: FloatArray
    """(3,) rotation vector in body axes, rad, from the configured mounting to the estimated one: ``R_body_camera =
    exp(turn) R_configured``."""
    time_offset_s: float
    """Added to its time stamps, besides the rig's configured offset."""
    focal_scale: float
    """Ratio of its focal lengths to the configured ones."""
    covariance: FloatArray
    """(5, 5) of turn, time offset, and the focal scale's logarithm."""
    readout_s: FloatArray
    """(2,) seconds in which rows are read one after the other, over the image's width (from its right: negative) and
    over its height; of all cameras together. Near 0: a global shutter."""
    readout_sigma_s: FloatArray
    """(2,) standard deviations."""
    elsewhere: bool = False
    """Whether its motion contradicts the drone's by more than a small error of the mounting: it is on its side or
    upside down, exchanged with another camera, or covered. The other numbers are then invalid."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The autopilot's state at the time of a frame set, and the time of each camera's image."""

    vehicle: VehicleState
    frames_s: float
    """Time of the frame set, on the frames' clock."""
    times_s: Mapping[str, float]
    """Of each camera's image, on the same clock."""


class Differs(NamedTuple):
    """Parameters of a camera that differ from the configured ones by at least four standard deviations."""

    turn: bool
    time: bool
    focal: bool


def differs(deviation: CameraDeviation) -> Differs:
    """As far as is known."""
    turn, covariance = deviation.turn, deviation.covariance
    return Differs(
        turn=float(turn @ np.linalg.solve(covariance[:3, :3], turn)) > _SURE_OF_TURN,
        time=deviation.time_offset_s**2 > _SURE * covariance[_OFFSET, _OFFSET],
        focal=math.log(deviation.focal_scale) ** 2 > _SURE * covariance[_FOCAL, _FOCAL],
    )


def rig_faults(deviation: CameraDeviation) -> tuple[str, ...]:
    """Sentences about the parameters of a camera that deserve a warning, for people."""
    if deviation.elsewhere:
        return (moves_otherwise(deviation.camera),)
    sure, found = differs(deviation), []
    if sure.turn and float(np.linalg.norm(deviation.turn)) > WORTH_TURN_RAD:
        found.append("it is not turned as configured")
    if sure.time and abs(deviation.time_offset_s) > WORTH_OFFSET_S:
        found.append("its time stamps are not as configured")
    if sure.focal and abs(math.log(deviation.focal_scale)) > WORTH_FOCAL:
        found.append("its focal length is not as configured")
    return tuple(f"camera {deviation.camera}: {text}" for text in found)


def described(deviation: CameraDeviation) -> str:
    """The deviation of a camera with standard deviations, for people."""
    sigma = np.sqrt(np.diag(deviation.covariance))
    turns = ", ".join(
        f"{axis} {math.degrees(angle):+.2f} +- {math.degrees(of_angle):.2f}"
        for axis, angle, of_angle in zip(("roll", "pitch", "yaw"), deviation.turn, sigma[_TURN], strict=True)
    )
    return (
        f"turned by {turns} degrees, time {1e3 * deviation.time_offset_s:+.0f} +- {1e3 * sigma[_OFFSET]:.0f} ms, "
        f"focal length {100 * (deviation.focal_scale - 1):+.1f} +- {100 * sigma[_FOCAL]:.1f} %"
    )


def rolling(deviation: CameraDeviation) -> tuple[str, ...]:
    """One sentence for each side of the images over which rows are read one after the other, as far as is known."""
    sides = zip(("width", "height"), deviation.readout_s, deviation.readout_sigma_s, strict=True)
    return tuple(
        f"rows are read over the images' {side} in {1e3 * time_s:+.0f} +- {1e3 * sigma_s:.0f} ms: a rolling shutter"
        for side, time_s, sigma_s in sides
        if time_s**2 > _SURE * sigma_s**2
    )


@dataclass
class _Camera:
    mounted: RigCamera
    R_body_camera: FloatArray
    offset_s: float = 0.0
    log_focal: float = 0.0
    misfit: float = 1.0
    """Ratio of its squared errors to its own covariance."""
    agreement: float = 0.0
    """Agreement of its last motions with the body's: 1, contradiction -1, not known 0."""


@dataclass(frozen=True, eq=False)
class _Sight:
    """How one camera moved, and how it was expected to move: what the rounds of an update have in common."""

    camera: _Camera
    place: int
    """Of the camera in the state."""
    motion: CameraMotion
    rates: tuple[FloatArray, FloatArray]
    """(3,) rad/s of turn at both images, body axes."""
    turn: FloatArray
    """(3, 3) the body's."""
    way: FloatArray
    """(3,) metres that the camera is expected to have gone, in the body's axes at the first image."""
    R_body_ned: FloatArray
    """(3, 3) at the first image."""
    by_shared: FloatArray
    """(6, 5) by readout, and the velocity's error."""
    measured: FloatArray
    """(6,) how the camera turned and went beside what is expected, body axes."""
    spread: FloatArray
    """(6, 6) covariance of it."""


class RigCalibration:
    """The filter of one rig. Its state has the mounting, time offset and focal length of each camera, and parameters
    common to all."""

    def __init__(self, rig: Rig, judge: RigCalibration | None = None) -> None:
        """``judge``: a filter of other looks of the same flight, which is used up. Measurements that contradict its
        result are left out: a new filter would accept wrong ones, for example in front of the sky."""
        self._judge = judge
        if judge is not None:
            judge._wait(math.inf)  # the velocity's error was another one then
        self._cameras = {
            name: _Camera(mounted, mounted.T_body_camera.rotation) for name, mounted in rig.cameras.items()
        }
        sigmas = [PRIOR_TURN_RAD] * 3 + [PRIOR_OFFSET_S, PRIOR_FOCAL]
        shared = [_READOUT_S] * 2 + [_VELOCITY_SIGMA_M_S] * 3
        self._covariance = np.diag(np.array(sigmas * len(self._cameras) + shared) ** 2)
        self._readout = np.zeros(2)
        self._velocity_error = np.zeros(3)
        self._turn_variance = _TURN_SIGMA_RAD**2
        self._time_s: float | None = None
        """Of the last update."""

    def update(self, before: Seen, after: Seen, pairs: PointPairs) -> None:
        """Takes the background pairs of two frame sets that are at most some seconds apart.

        Pairs farther apart, and numbers that are not finite, are ignored.
        """
        interval_s = after.vehicle.time_s - before.vehicle.time_s
        if not 0.0 < interval_s <= _MAX_INTERVAL_S:
            return
        time_s, before_s = after.vehicle.time_s, self._time_s
        elapsed_s = interval_s if before_s is None or time_s <= before_s else time_s - before_s
        if before_s is not None and elapsed_s < _EVERY_S:
            return
        self._time_s = time_s
        self._wait(elapsed_s)
        with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError, ValueError):
            self._take(before, after, pairs, interval_s)

    def _take(self, before: Seen, after: Seen, pairs: PointPairs, interval_s: float) -> None:
        """The state and the body's motion together, beside what the autopilot says of it, by least squares."""
        turned_rad = np.linalg.norm(vector_from_rotation(before.vehicle.R_ned_body.T @ after.vehicle.R_ned_body))
        moves = bool(np.linalg.norm(_went(before, after)) > _MOVES_M or turned_rad > _MOVES_RAD)
        looks = before, after, pairs
        sights = ((name, self._sight(name, *looks)) for name in self._cameras)
        fitting = [(name, sight) for name, sight in sights if sight is not None and self._fits(sight, moves=moves)]
        used = [sight for name, sight in fitting if self._judge is None or self._judge.expects(name, *looks)]
        if not used:
            return
        size, off = len(self._covariance), np.zeros(6)
        prior = np.zeros((size + 6, size + 6))
        prior[:size, :size] = np.linalg.inv(self._covariance)
        noise_m = (_UNKNOWN_M_S if before.vehicle.velocity_ned is None else _VELOCITY_NOISE_M_S) * interval_s
        prior[range(size, size + 6), range(size, size + 6)] = [1.0 / self._turn_variance] * 3 + [noise_m**-2] * 3
        for _ in range(_ROUNDS):
            hessian, gradient = prior.copy(), np.zeros(size + 6)
            for sight in used:
                J = self._jacobian(sight, off)
                weighted = J.T @ np.linalg.inv(sight.camera.misfit * sight.spread)
                hessian += weighted @ J
                gradient += weighted @ sight.measured
            covariance = np.linalg.inv(hessian)
            found = covariance @ gradient
            off = found[size:].copy()
            off[3:] += found[size - 3 : size] * interval_s
        variances = np.diag(covariance)
        if np.isfinite(found).all() and np.isfinite(covariance).all() and (variances[:size] > 0.0).all():
            self._covariance = (covariance + covariance.T)[:size, :size] / 2.0
            self._move(found[:size])
            jitter = float(np.mean(found[size : size + 3] ** 2 + variances[size : size + 3]))
            self._turn_variance += _TURN_GAIN * (max(jitter, _LEAST_TURN_RAD**2) - self._turn_variance)

    def deviations(self) -> tuple[CameraDeviation, ...]:
        """The deviation of each camera."""
        found, shared = [], np.sqrt(np.diag(self._covariance)[-_SHARED:])
        for place, (name, camera) in enumerate(self._cameras.items()):
            mine = slice(place * _SIZE, (place + 1) * _SIZE)
            found.append(
                CameraDeviation(
                    camera=name,
                    turn=vector_from_rotation(camera.R_body_camera @ camera.mounted.T_body_camera.rotation.T),
                    time_offset_s=camera.offset_s,
                    focal_scale=math.exp(camera.log_focal),
                    covariance=self._covariance[mine, mine] + _LASTING,
                    elsewhere=camera.agreement < -_AGREES,
                    readout_s=self._readout.copy(),
                    readout_sigma_s=shared[:2].copy(),
                )
            )
        return tuple(found)

    def _wait(self, interval_s: float) -> None:
        """Increases the uncertainty of the velocity's error with time."""
        keep = math.exp(-interval_s / _VELOCITY_TIME_S)
        kept = np.ones(len(self._covariance))
        kept[-3:] = keep
        self._covariance = self._covariance * np.outer(kept, kept)
        self._covariance[-3:, -3:] += (1.0 - keep**2) * _VELOCITY_SIGMA_M_S**2 * np.eye(3)
        self._velocity_error = keep * self._velocity_error

    def _sight(self, name: str, before: Seen, after: Seen, pairs: PointPairs) -> _Sight | None:
        if name not in before.times_s or name not in after.times_s:
            return None
        camera = self._cameras[name]
        R = camera.R_body_camera
        turn, went = _body_motion(before, after, name, camera.offset_s, self._velocity_error)
        way = went + (turn - np.eye(3)) @ camera.mounted.T_body_camera.translation
        start = RigidTransform(R.T @ turn @ R, R.T @ way)
        motion = camera_motion(camera.mounted, pairs, start, camera.log_focal)
        if motion is None:
            return None
        rates, R_body_ned = (_rate(before), _rate(after)), _attitude(before, name, camera.offset_s).T
        # Into body axes: the rotation from the right, and the translation, are turned by the mounting alike.
        into, by_shared = _into(R), np.zeros((6, _SHARED))
        by_shared[:, :2] = -into @ motion.by_readout(start, (R.T @ rates[0], R.T @ rates[1]))
        by_shared[3:, 2:] = R_body_ned * (after.vehicle.time_s - before.vehicle.time_s)
        turned, gone = R @ motion.motion.rotation @ R.T, R @ motion.motion.translation
        spread = into @ np.linalg.inv(motion.information) @ into.T
        spread[3:, 3:] += (_WAY_SIGMA * np.linalg.norm(gone)) ** 2 * np.eye(3)
        return _Sight(
            camera=camera,
            place=_SIZE * list(self._cameras).index(name),
            motion=motion,
            rates=rates,
            turn=turn,
            way=way,
            R_body_ned=R_body_ned,
            by_shared=by_shared,
            measured=np.concatenate([vector_from_rotation(turn.T @ turned), gone - way])
            - by_shared[:, :2] @ self._readout,
            spread=spread,
        )

    def _jacobian(self, sight: _Sight, off: FloatArray) -> FloatArray:
        """(6, n + 6) of what is measured by the state, and by how much the autopilot's turn and way are off.

        About what the body did by all that is known, ``off`` (6,) beside the autopilot: about the autopilot's alone, or
        the camera's alone, the noise of either would count as motion.
        """
        R, (first, second), size = sight.camera.R_body_camera, sight.rates, len(self._covariance)
        about, near = sight.turn @ rotation_from_vector(off[:3]), sight.way + sight.R_body_ned @ off[3:]
        J = np.zeros((6, size + 6))
        mine = J[:, sight.place : sight.place + _SIZE]
        mine[:3, _TURN] = np.eye(3) - about.T
        mine[:3, _OFFSET] = second - about.T @ first
        mine[3:, _TURN] = cross_matrix(near)
        mine[3:, _OFFSET] = mine[3:, _TURN] @ first
        mine[:, _FOCAL] = -_into(R) @ sight.motion.by_focal(RigidTransform(R.T @ about @ R, R.T @ near))
        J[:, size - _SHARED : size] = sight.by_shared
        J[:3, size : size + 3], J[3:, size + 3 :] = np.eye(3), sight.R_body_ned
        return J

    def expects(self, name: str, before: Seen, after: Seen, pairs: PointPairs) -> bool:
        """Whether a camera's motion agrees with the current estimate; 99 % do."""
        sight = self._sight(name, before, after, pairs)
        return sight is not None and self._square(sight) < _MAX_UNEXPECTED

    def _square(self, sight: _Sight) -> float:
        """Normalised square of the difference between a camera's motion and the expected one."""
        size, J = len(self._covariance), self._jacobian(sight, np.zeros(6))
        noise = np.diag([self._turn_variance] * 3 + [_VELOCITY_NOISE_M_S**2] * 3)
        spread = sight.camera.misfit * sight.spread + J[:, size:] @ noise @ J[:, size:].T
        spread += J[:, :size] @ self._covariance @ J[:, :size].T
        return float(sight.measured @ np.linalg.solve(spread, sight.measured)) / len(sight.measured)

    def _fits(self, sight: _Sight, *, moves: bool) -> bool:
        """Whether a camera's motion is plausible. Also learns the size of its errors, and, if the drone moves, its
        agreement."""
        camera, square = sight.camera, self._square(sight)
        if not math.isfinite(square):
            return False
        misfit = camera.misfit * min(max(square, 0.1), _MAX_MISFIT) ** _FIT_GAIN
        camera.misfit = min(max(misfit, 1.0), _MAX_INFLATION)
        fits = square < _MAX_MISFIT
        if moves:
            camera.agreement += _AGREEMENT_GAIN * ((1.0 if fits else -1.0) - camera.agreement)
        return fits

    def _move(self, step: FloatArray) -> None:
        for place, camera in enumerate(self._cameras.values()):
            mine = step[place * _SIZE : (place + 1) * _SIZE]
            camera.R_body_camera = rotation_from_vector(mine[_TURN]) @ camera.R_body_camera
            camera.offset_s += float(mine[_OFFSET])
            camera.log_focal += float(mine[_FOCAL])
        self._readout = self._readout + step[-_SHARED:-3]
        self._velocity_error = self._velocity_error + step[-3:]


def _rate(seen: Seen) -> FloatArray:
    """(3,) rad/s, body axes; zero where it is not known, so that the time cannot be estimated."""
    rate = seen.vehicle.turn_rate
    return np.zeros(3) if rate is None else rate


def _attitude(seen: Seen, camera: str, offset_s: float) -> FloatArray:
    """(3, 3) ``R_ned_body`` when the camera took its image."""
    late_s = seen.times_s[camera] - seen.frames_s + offset_s
    return seen.vehicle.R_ned_body @ rotation_from_vector(_rate(seen) * late_s)


def _went(before: Seen, after: Seen) -> FloatArray:
    """(3,) metres NED."""
    velocities = [one.vehicle.velocity_ned for one in (before, after)]
    if velocities[0] is None or velocities[1] is None:
        return np.zeros(3)
    return (after.vehicle.time_s - before.vehicle.time_s) * (velocities[0] + velocities[1]) / 2.0


def _body_motion(
    before: Seen, after: Seen, camera: str, offset_s: float, velocity_error: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(3, 3) the body's turn between two images of a camera, and (3,) metres that it went, in its axes at the first."""
    first, second = (_attitude(one, camera, offset_s) for one in (before, after))
    went = _went(before, after) + velocity_error * (after.vehicle.time_s - before.vehicle.time_s)
    return first.T @ second, first.T @ went


def _into(rotation: FloatArray) -> FloatArray:
    """(6, 6) that turns a rotation vector and a translation alike."""
    into = np.zeros((6, 6))
    into[:3, :3] = into[3:, 3:] = rotation
    return into
