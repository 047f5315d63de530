"""Neighbours as the drone's own tracker makes them of detections that are made up from the truth."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from flockd.core.messages import BoolArray, FloatArray, Neighbour
from flockd.flight.geometry import build_rig, rotation_from_euler
from flockd.flight.tracking import Measurement, Tracker
from flockd.sim.scenario import DetectionsConfig, ScenarioConfig

_OWN_MOTION_ERROR_M = 0.02
"""Standard deviation of a drone's motion in a step, each axis, of which the tracker is told. Where the scenario is
`ideal` the motion is exact."""


class TrackedNeighbours:
    """What one drone knows of the others."""

    def __init__(self, scenario: ScenarioConfig, config: DetectionsConfig, drone: int) -> None:
        self._config, self._drone, self._step_s = config, drone, scenario.drone.step_s
        self._scenario, self._rig = scenario, build_rig(scenario.drone.rig)
        self._tracker = Tracker(scenario.drone.tracking)
        self._random = np.random.default_rng([scenario.seed, drone])
        self._errors = self._random.normal(size=(len(scenario.vehicles) - 1, 5))
        """Of each other drone, in standard deviations: of the range's logarithm and the bearing (3), and the normal
        number that decides whether it is missed."""
        self._position: FloatArray | None = None

    def step(
        self, time_s: float, positions: FloatArray, velocities: FloatArray, yaw_rad: float = 0.0,
        cameras_off: frozenset[str] = frozenset(),
    ) -> tuple[Neighbour, ...]:  # fmt: skip
        """With all drones at (n, 3) m and (n, 3) m/s in NED, and the drone's own heading; called once a step.

        Nobody is detected but in the view of a camera that has no fault and is on.
        """
        here = positions[self._drone]
        if self._position is not None:
            wrong_m = 0.0 if self._scenario.ideal else self._random.normal(0.0, _OWN_MOTION_ERROR_M, 3)
            self._tracker.predict(self._step_s, here - self._position + wrong_m, _OWN_MOTION_ERROR_M)
        self._position = here
        offsets = np.delete(positions, self._drone, axis=0) - here
        times_s = (self._config.error_time_s,) * 4 + (self._config.missed_time_s,)
        keep = np.array([math.exp(-self._step_s / time_s) if time_s else 0.0 for time_s in times_s])
        fresh = self._random.normal(size=self._errors.shape)
        self._errors = keep * self._errors + np.sqrt(1.0 - keep**2) * fresh
        made_up = (self._detection(*pair) for pair in zip(offsets, self._errors, strict=True))
        found = [detection for detection in made_up if detection is not None]
        gone = lost_cameras(self._scenario, self._drone, time_s) | cameras_off
        R_ned_body = rotation_from_euler(0.0, 0.0, yaw_rad)

        def shown(places: FloatArray, radius_m: float) -> BoolArray:
            return self._rig.shows(places @ R_ned_body, radius_m, gone)

        found = [one for one in found if shown(one.position[None], 0.0)[0]]
        self._tracker.update(time_s, found, velocities[self._drone], shown)
        return self._tracker.neighbours()

    def _detection(self, offset: FloatArray, errors: FloatArray) -> Measurement | None:
        config = self._config
        range_m = float(np.linalg.norm(offset))
        if range_m > config.range_m or errors[4] < ndtri(config.missed):
            return None
        bearing = offset / range_m + config.bearing_error_rad * errors[1:4]
        bearing /= np.linalg.norm(bearing)
        across, along = config.bearing_error_rad**2, config.range_error**2
        covariance = across * np.eye(3) + (along - across) * np.outer(bearing, bearing)
        log_range = float(np.log(range_m) + config.range_error * errors[0])
        return Measurement(bearing, log_range, covariance, 0.6, 0.95)


def lost_cameras(scenario: ScenarioConfig, drone: int, time_s: float) -> frozenset[str]:
    """The names of one drone's cameras that have a fault at this time."""
    return frozenset(
        fault.camera for fault in scenario.faults if fault.drone == drone + 1 and fault.begin_s <= time_s < fault.end_s
    )
