"""The ground below the drone as a plane, estimated from ranges and the own motion.

A Kalman filter with three states: the ground's height below the drone, in the frame of the autopilot's height, and its
slopes to the north and to the east. As the drone moves, the height changes by the slope. A range measures the height at
one point; successive points show the slope along the path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flockd.core.choices import HeightSource
from flockd.core.config.perception import RangeFinderParameters
from flockd.core.consistency import RANGE_REPEATED, RANGE_VISION
from flockd.core.messages import FloatArray, GroundEstimate, RangeReading, Reason, ReasonKind, VehicleState
from flockd.flight.pilot.own_motion import ERROR_LASTS_S, ERROR_M_S, SCALE

HEIGHT_NOISE_M = 0.03
"""Standard deviation of the autopilot's height between readings. Its slow drift does not matter here."""
SLOPE_CHANGE = 0.02
"""Standard deviation of the change of slope per metre: a hill of 5 m goes from 15 % up to 15 % down in 100 m."""
ROUGHNESS_M = 0.03
"""Standard deviation by which the ground departs from its slope over a metre."""
PROBATION_S = 3.0
"""Time for which a blamed range finder has to agree with itself before it is used again."""


class GroundFilter:
    """Estimates the ground below one drone. Call `update` once a step."""

    def __init__(self, source: HeightSource, parameters: RangeFinderParameters) -> None:
        self._source, self._parameters = source, parameters
        self._state: FloatArray | None = None
        """(3,) height above the zero of the autopilot's height in metres, slope to the north, slope to the east."""
        self._covariance = np.zeros((3, 3))
        self._last: VehicleState | None = None
        self._measured_s = -math.inf
        self._flown = np.zeros(2)
        """(2,) metres north and east since the start, by the autopilot."""
        self._contradictions = ContradictionMonitor(parameters)
        self._newest: GroundPoint | None = None
        """Where the newest step's range hit the ground, used or not; None: the step had no range."""
        self._elapsed_s = 0.0
        """Duration of the newest step."""
        self._moved: FloatArray | None = None
        """(3,) displacement in the newest step by the autopilot's velocities, metres NED; None: not known."""
        self._used_height_m = 0.0
        """Height above the ground from which the newest step's scale follows."""

    def update(self, vehicle: VehicleState) -> tuple[GroundEstimate | None, Reason | None]:
        """The ground in this step, and the reason if another source than the configured one is used."""
        if self._source == "barometer":
            return level_ground(vehicle), None
        fault = self._follow(vehicle)
        age_s, ground, reason = vehicle.time_s - self._measured_s, None, None
        if self._state is not None and (fault is None or age_s <= self._parameters.bridge_s):
            ground = GroundEstimate(vehicle.height_m - float(self._state[0]), self._state[1:].copy(), "range_finder")
        elif self._source == "best":
            ground = level_ground(vehicle)
            reason = Reason(ReasonKind.HEIGHT, f"height: {fault}; the barometer's is used")
        else:
            reason = Reason(ReasonKind.HEIGHT, f"height: {fault}; there is no scale")
        self._used_height_m = 0.0 if ground is None else ground.height_m
        return ground, reason

    def see_motion(self, displacement: FloatArray) -> None:
        """Takes the displacement (3,), metres NED, that images show in the newest step, in the scale of its ground."""
        if self._newest is None or self._moved is None:
            return
        heights_m = np.array([self._newest.height_m - self._newest.ground_m, self._newest.height_m])
        if heights_m[0] > 0.0 and self._used_height_m > 0.0:
            by_images = np.outer(heights_m / self._used_height_m, displacement)
            self._contradictions.see_way(self._elapsed_s, self._moved, by_images)

    def _follow(self, vehicle: VehicleState) -> str | None:
        """Takes a step and its range. Returns why the range is not used; None: it is."""
        self._newest = None
        self._predict(vehicle)
        reading = vehicle.ground_range
        fault = reading_fault(reading, vehicle.time_s, self._parameters)
        if reading is None or fault is not None:
            return fault
        point = reading.range_m * vehicle.R_ned_body[:, 2]
        ground_m = _height_at(reading.time_s, vehicle) - float(point[2])
        self._newest = GroundPoint(vehicle.time_s, self._flown, reading.range_m, vehicle.height_m, ground_m)
        self._contradictions.see_repetition(self._newest)
        variance = (self._parameters.noise * reading.range_m) ** 2 + HEIGHT_NOISE_M**2
        row = np.array([1.0, point[0], point[1]])
        if self._contradictions.why is None and self._is_unexplained(row, ground_m, variance):
            return "the range is not that of the ground expected"
        home = None if vehicle.position is None else self._flown - vehicle.position
        why = self._contradictions.update(self._newest, home)
        if why is not None:  # earlier readings may have been wrong as well
            self._state = None
            return why
        if self._state is None:
            self._state = np.array([ground_m, 0.0, 0.0])
            slope = self._parameters.max_slope / self._parameters.gate_sigma
            self._covariance = np.diag([variance, slope**2, slope**2])
        else:
            self._correct(row, ground_m, variance)
        self._measured_s = vehicle.time_s
        return None

    def _is_unexplained(self, row: FloatArray, ground_m: float, variance: float) -> bool:
        """Whether a reading is outside the gate. If so the variance grows, so that a second one like it fits."""
        if self._state is None:
            return False
        off_m, gate = abs(ground_m - float(row @ self._state)), self._parameters.gate_sigma
        if off_m <= gate * math.sqrt(float(row @ self._covariance @ row) + variance):
            return False
        self._covariance = self._covariance + np.diag([(2.0 * off_m / gate) ** 2, 0.0, 0.0])
        return True

    def _predict(self, vehicle: VehicleState) -> None:
        last, self._last = self._last, vehicle
        if last is None:
            return
        self._elapsed_s, self._moved = vehicle.time_s - last.time_s, _moved(last, vehicle)
        way = _way(last, vehicle)
        if way is None or not 0.0 < self._elapsed_s <= self._parameters.compare_s:
            self._state = None
            self._contradictions.forget()
            return
        self._flown = self._flown + way
        if self._state is None:
            return
        onward = np.eye(3)
        onward[0, 1:] = way
        length_m = float(np.hypot(*way))
        change = np.array([ROUGHNESS_M**2, SLOPE_CHANGE**2, SLOPE_CHANGE**2]) * length_m
        self._state = onward @ self._state
        self._covariance = onward @ self._covariance @ onward.T + np.diag(change)

    def _correct(self, row: FloatArray, ground_m: float, variance: float) -> None:
        assert self._state is not None
        gain = self._covariance @ row / (row @ self._covariance @ row + variance)
        self._state = self._state + gain * (ground_m - row @ self._state)
        kept = np.eye(3) - np.outer(gain, row)  # Joseph's form keeps it symmetric
        self._covariance = kept @ self._covariance @ kept.T + variance * np.outer(gain, gain)


@dataclass(frozen=True, eq=False)
class GroundPoint:
    """A point of the ground that a range finder measured."""

    time_s: float
    place: FloatArray
    """(2,) metres north and east of a fixed origin: the drone's place, as the beam's also moves with its tilt."""
    range_m: float
    """Slant range, as measured."""
    height_m: float
    """Height of the drone by the barometer."""
    ground_m: float
    """Height of the ground at this point, above the barometer's zero."""


class ContradictionMonitor:
    """Detects ranges to the ground that contradict the barometer, each other, or the distance flown.

    Call `update` for each reading, and `see_way` if images show the displacement.

    The drone's height minus the range is the ground's height. Each range puts it between two bounds. The bounds widen
    with the distance flown, by the steepest slope of the ground, and with time, by the barometer's drift; each new
    range narrows them. A reading outside them by more than a step of the ground is not of the ground: the beam hit the
    landing gear or a cable, or the range jumped. Two sensors cannot show which of them is wrong. The range finder is
    blamed, since the autopilot flies by the barometer. Ground that rises as fast as the drone climbs looks like a range
    that is stuck. Two tests tell them apart: whether readings are equal to the last bit, and whether the distance flown
    by the images, whose scale comes from the range, is wrong by the same factor.
    """

    def __init__(self, parameters: RangeFinderParameters) -> None:
        self._parameters = parameters
        self.why: str | None = None
        """Why the range finder is not used; None: it is."""
        self._before_m = 0.0
        """Height of the ground before the range finder was blamed."""
        self._same: GroundPoint | None = None
        """The first of the readings that are equal to the last bit."""
        self.forget()

    def forget(self) -> None:
        """Drops earlier readings, with which later ones cannot be compared. Blame remains."""
        self._first: GroundPoint | None = None
        """The first reading, since the range finder was blamed, that agrees with those after it."""
        self._newest: GroundPoint | None = None
        self._bounds_m = np.array([-math.inf, math.inf])
        """(2,) bounds of the ground's height below the drone at the newest reading."""
        self._way = np.zeros(3)
        """(3,) fading sums: squared displacement by the autopilot, and the images' displacements along it."""

    def doubt(self, why: str) -> None:
        """Blames the range finder; it is not used until its next readings agree with each other."""
        if self.why is None:
            self._before_m = 0.0 if self._newest is None else float(self._bounds_m.mean())
        self.why, self._first = why, None

    def see_repetition(self, point: GroundPoint) -> None:
        """Blames the range finder if its readings stay equal while the height changes."""
        if self._same is None or point.range_m != self._same.range_m:
            self._same = point
        elif abs(point.ground_m - self._same.ground_m) >= RANGE_REPEATED.limit:  # as of each reading's own time
            self.doubt("the range stays the same while the height changes")

    def see_way(self, elapsed_s: float, flown: FloatArray, by_images: FloatArray) -> None:
        """Blames the range finder if images contradict the autopilot in its scale more than in the barometer's.

        Args:
            elapsed_s: duration of the step.
            flown: (3,) displacement by the autopilot, metres NED.
            by_images: (2, 3) displacement by the images, in the range finder's scale and in the barometer's.
        """
        kept = math.exp(-elapsed_s / self._parameters.compare_s)
        self._way = kept * self._way + np.array([flown @ flown, *(by_images @ flown)])
        square, *along = self._way.tolist()
        if not square > 0.0:
            return
        of_velocity = ERROR_M_S * math.sqrt(2.0 * ERROR_LASTS_S * elapsed_s / square)  # mean of a Gauss-Markov error
        off, off_by_barometer = (abs(one / square - 1.0) for one in along)
        if off > RANGE_VISION.limit * math.hypot(SCALE, of_velocity) and off_by_barometer < off:
            self.doubt("the range contradicts the way flown")

    def update(self, point: GroundPoint, home: FloatArray | None) -> str | None:
        """Takes a reading. Returns why it may not be used; None: it may.

        Args:
            point: where the range hit the ground.
            home: (2,) place at which the ground's height is zero, as `GroundPoint.place`; None: not known. Only used
                for the first reading.
        """
        p = self._parameters
        if self._newest is not None:
            drifted_m = p.tolerance_m * (point.time_s - self._newest.time_s) / p.compare_s
            self._widen(p.max_slope * math.dist(point.place, self._newest.place) + drifted_m)
        elif home is not None and self.why is None:
            self._bounds_m = np.zeros(2)
            self._widen(p.max_slope * math.dist(point.place, home))
        said_m = point.ground_m + p.gate_sigma * p.noise / 2.0 * point.range_m * np.array([-1.0, 1.0])
        if max(self._bounds_m[0] - said_m[1], said_m[0] - self._bounds_m[1]) > p.tolerance_m:
            self.doubt(self.why or "the range contradicts the barometer")
            self.forget()
        self._first, self._newest = self._first or point, point
        self._bounds_m = np.array([max(self._bounds_m[0], said_m[0]), min(self._bounds_m[1], said_m[1])])
        if self.why is not None and self._is_rehabilitated(self._first, point):
            self.why = None
        return self.why

    def _widen(self, by_m: float) -> None:
        self._bounds_m = self._bounds_m + np.array([-by_m, by_m])

    def _is_rehabilitated(self, first: GroundPoint, newest: GroundPoint) -> bool:
        """Whether readings agree with each other and with the ground as it was before, or else follow the height.

        A range that is stuck or blocked does not follow it.
        """
        if newest.time_s - first.time_s < PROBATION_S:
            return False
        off_m = abs(float(self._bounds_m.mean()) - self._before_m)
        followed_m = abs(newest.range_m - first.range_m)
        return bool(off_m <= self._parameters.tolerance_m or followed_m >= self._parameters.tolerance_m)


def reading_fault(reading: RangeReading | None, now_s: float, parameters: RangeFinderParameters) -> str | None:
    """Why a range cannot be used; None: it can."""
    if reading is None:
        return "no range finder is heard"
    if not math.isfinite(reading.range_m):
        return "the range is not a number"
    if not abs(now_s - reading.time_s) <= parameters.max_age_s:
        return "the range is too old"
    if reading.quality is not None and reading.quality < parameters.min_quality:
        return "the range finder's signal is too weak"
    if reading.range_m <= (reading.min_m or 0.0):
        return "the ground is nearer than the range finder measures"
    if reading.max_m is not None and reading.range_m >= reading.max_m:
        return "the ground is farther than the range finder measures"
    return None


def level_ground(vehicle: VehicleState) -> GroundEstimate:
    """Level ground at height zero of the autopilot."""
    return GroundEstimate(vehicle.height_m, np.zeros(2), "barometer")


def _height_at(time_s: float, vehicle: VehicleState) -> float:
    """The drone's height at a time near that of the vehicle's state, by its vertical speed."""
    sink_m_s = 0.0 if vehicle.velocity_ned is None else float(vehicle.velocity_ned[2])
    return vehicle.height_m + sink_m_s * (vehicle.time_s - time_s)


def _way(before: VehicleState, now: VehicleState) -> FloatArray | None:
    """(2,) displacement north and east in metres by the autopilot; None: not known."""
    if before.position is not None and now.position is not None:
        return now.position - before.position
    moved = _moved(before, now)
    return None if moved is None else moved[:2]


def _moved(before: VehicleState, now: VehicleState) -> FloatArray | None:
    """(3,) displacement by the autopilot's velocities, metres NED; its positions jump when its estimator is reset."""
    if before.velocity_ned is None or now.velocity_ned is None:
        return None
    return 0.5 * (before.velocity_ned + now.velocity_ned) * (now.time_s - before.time_s)
