"""flockd's tracker and Stone Soup's (GNN, JPDA, GM-PHD) on the same recorded detections, by Stone Soup's own metrics.

Each step's detections of a recorded flight by sight, with their covariances, and the own motion as the drone estimated
it, go to each tracker; what it confirms is compared with the true neighbours within 10 m: GOSPA and OSPA (p = 2,
cut-off 2 m; the mean over steps, smaller is better), GOSPA's parts (root of the mean square), and how often a neighbour
changed its track. Stone Soup 1.9 is no dependency: install it into an environment of its own, with flockd.

    python -m tools.measure.stone_soup out/flight/recordings
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.dataassociator.probability import JPDA
from stonesoup.deleter.time import UpdateTimeStepsDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.metricgenerator.ospametric import GOSPAMetric, OSPAMetric
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState, State, TaggedWeightedGaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater
from stonesoup.updater.pointprocess import PHDUpdater

from flockd import Recording
from flockd.core.messages import Detection as Sighting
from flockd.core.messages import FloatArray
from flockd.flight.tracking import Measurement, Tracker
from flockd.onboard.recording.codec import from_json

CUT_OFF_M, POWER = 2.0, 2.0
WITHIN_M = 10.0
DETECTED, CLUTTER_PER_M3 = 0.9, 1e-4
"""As Stone Soup's trackers are told: of the detections of these flights."""
ACCELERATION = 0.05
"""Spectral density, m^2/s^3, of a neighbour's velocity: about that of flockd's tracker (0.2 m/s^2 for 0.5 s, and more
in turns)."""
SPEED_SIGMA_M_S = 1.0
POINTS, UNSEEN_STEPS = 3, 3
"""As flockd's tracker confirms, and drops."""
PHD_BORN, PHD_FOUND, PHD_SURVIVAL = 0.1, 0.5, 0.99
"""Weights of a component that is born, and from which on it counts; its probability of surviving a step."""
PHD_GATE, PHD_MERGE = 4, 5
"""Mahalanobis distances: of detections from components, and of components that become one."""
EPOCH = datetime(2026, 1, 1)
Positions = dict[int, FloatArray]
"""By track, (3,) metres NED from where the recording began."""


@dataclass(frozen=True)
class Step:
    """What one step gives to a tracker, and the truth."""

    time_s: float
    own: FloatArray
    """(3,) metres NED from where the recording began, by the own estimate."""
    way: FloatArray
    """(3,) since the last step."""
    velocity: FloatArray | None
    seen: list[Measurement]
    true: FloatArray
    """(n, 3) metres NED from `own`, of all neighbours."""


def steps_of(path: Path) -> list[Step]:
    """Of a recording that holds the truth; its drone is the one that its name ends with."""
    number = int("".join(c for c in path.stem if c.isdigit())) - 1
    steps, own, before = [], np.zeros(3), np.eye(3)
    for one in Recording(path).steps():
        if one.output is None or one.truth is None:
            continue
        ego, velocity = one.output.get("ego_motion"), one.output.get("velocity")
        way = np.zeros(3) if ego is None else before @ np.array(ego["translation"])
        own, before = own + way, one.vehicle.R_ned_body
        detections = [from_json(Sighting, data) for data in one.output["detections"]]
        places = np.array([drone.position for drone in one.truth.drones])
        steps.append(
            Step(
                one.output["time_s"],
                own,
                way,
                None if velocity is None else np.array(velocity),
                [Measurement.of(detection, before) for detection in detections],
                np.delete(places, number, axis=0) - places[number],
            )
        )
    return steps


def by_flockd(steps: list[Step]) -> Iterator[Positions]:
    """What flockd's tracker confirms, step by step."""
    tracker, last_s = Tracker(), steps[0].time_s
    for step in steps:
        if step.time_s > last_s:
            tracker.predict(step.time_s - last_s, step.way, 0.02)
        tracker.update(step.time_s, step.seen, step.velocity)
        last_s = step.time_s
        yield {one.track: step.own + one.position for one in tracker.neighbours() if one.confirmed}


def by_stone_soup(kind: str, steps: list[Step]) -> Iterator[Positions]:
    """What one of Stone Soup's trackers confirms."""
    numbers: dict[Any, int] = {}
    for _, tracks in _tracker(kind, [(EPOCH + timedelta(seconds=s.time_s), _detections(s)) for s in steps]):
        yield {numbers.setdefault(one.id, len(numbers)): _place(one.state) for one in tracks}


def _tracker(kind: str, detector: list[tuple[datetime, set[Detection]]]) -> Any:
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(ACCELERATION)] * 3))
    updater = ExtendedKalmanUpdater(measurement_model=None)
    deleter = UpdateTimeStepsDeleter(UNSEEN_STEPS)
    nearest = GNNWith2DAssignment(DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=4))
    prior = GaussianState(np.zeros((6, 1)), np.diag([100.0, SPEED_SIGMA_M_S**2] * 3))
    initiator = MultiMeasurementInitiator(prior, UpdateTimeStepsDeleter(2), nearest, updater, min_points=POINTS)
    if kind == "GNN":
        return MultiTargetTracker(initiator, deleter, detector, nearest, updater)
    probable = JPDA(PDAHypothesiser(predictor, updater, CLUTTER_PER_M3, DETECTED, prob_gate=0.999))
    return MultiTargetMixtureTracker(initiator, deleter, detector, probable, updater)


def by_gm_phd(steps: list[Step]) -> Iterator[Positions]:
    """What Stone Soup's Gaussian-mixture PHD filter finds: components of a weight above a half.

    New ones are born where the last step's detections were (B. Ristic, D. Clark, B.-N. Vo, B.-T. Vo, "Adaptive target
    birth intensity for PHD and CPHD filters", 2012).
    """
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(ACCELERATION)] * 3))
    updater = ExtendedKalmanUpdater(measurement_model=None)
    near = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=PHD_GATE)
    hypothesiser = GaussianMixtureHypothesiser(near, order_by_detection=True)
    filter_ = PHDUpdater(
        updater, clutter_spatial_density=CLUTTER_PER_M3, prob_detection=DETECTED, prob_survival=PHD_SURVIVAL
    )
    reducer = GaussianMixtureReducer(prune_threshold=1e-3, merge_threshold=PHD_MERGE)
    numbers: dict[Any, int] = {}
    components: list[Any] = []
    for step in steps:
        when = EPOCH + timedelta(seconds=step.time_s)
        hypotheses = hypothesiser.hypothesise(components, _detections(step), when, order_by_detection=True)
        components = reducer.reduce(filter_.update(hypotheses))
        found = [one for one in components if one.weight > PHD_FOUND]
        yield {numbers.setdefault(one.tag, len(numbers)): _place(one) for one in found}
        components += [_born(step, one, when, len(numbers) + index) for index, one in enumerate(step.seen)]


def _born(step: Step, seen: Measurement, when: datetime, number: int) -> Any:
    """The component of a detection."""
    along = np.outer(seen.bearing, seen.bearing)
    across = float(np.trace(seen.covariance) - seen.log_range_variance) / 2
    place = seen.range_m**2 * (seen.log_range_variance * along + across * (np.eye(3) - along))
    covariance = np.zeros((6, 6))
    covariance[::2, ::2], covariance[1::2, 1::2] = place, SPEED_SIGMA_M_S**2 * np.eye(3)
    velocity = np.zeros(3) if step.velocity is None else step.velocity
    mean = np.stack([step.own + seen.position, velocity], axis=1).reshape(6, 1)
    tag = f"{when.isoformat()} {number}"
    return TaggedWeightedGaussianState(mean, covariance, timestamp=when, weight=PHD_BORN, tag=tag)


def _detections(step: Step) -> set[Detection]:
    found = set()
    for one in step.seen:
        across = float(np.trace(one.covariance) - one.log_range_variance) / 2
        model = CartesianToElevationBearingRange(
            ndim_state=6,
            mapping=(0, 2, 4),
            noise_covar=np.diag([across, across, one.range_m**2 * one.log_range_variance]),
            translation_offset=step.own[:, None],
        )
        north, east, down = one.bearing
        vector = [Elevation(math.asin(down)), Bearing(math.atan2(east, north)), one.range_m]
        when = EPOCH + timedelta(seconds=step.time_s)
        found.add(Detection(np.array(vector, dtype=object)[:, None], timestamp=when, measurement_model=model))
    return found


def _place(state: Any) -> FloatArray:
    return np.asarray(state.mean, float)[[0, 2, 4]].ravel()


class Scores:
    """Sums of Stone Soup's metrics over the steps of some flights."""

    def __init__(self) -> None:
        self._gospa = GOSPAMetric(p=POWER, c=CUT_OFF_M)
        self._ospa = OSPAMetric(p=POWER, c=CUT_OFF_M)
        self._rows: list[tuple[float, ...]] = []
        self._switches = 0

    def add(self, steps: list[Step], found: Iterator[Positions]) -> None:
        """One drone's flight."""
        last: dict[int, int] = {}
        for step, tracks in zip(steps, found, strict=True):
            within = [j for j, place in enumerate(step.true) if np.linalg.norm(place) <= WITHIN_M]
            true = [State(step.true[j][:, None]) for j in within]
            numbers = [n for n, place in tracks.items() if np.linalg.norm(place - step.own) <= WITHIN_M + CUT_OFF_M]
            states = [State((tracks[n] - step.own)[:, None]) for n in numbers]
            metric, assigned = self._gospa.compute_gospa_metric(states, true)
            parts: Mapping[str, float] = metric.value
            ospa = self._ospa.compute_OSPA_distance(states, true).value if states or true else 0.0
            squares = (abs(float(parts[name])) for name in ("localisation", "missed", "false"))
            self._rows.append((float(parts["distance"]), float(ospa), *squares))
            for j, k in zip(within, assigned, strict=False):  # none are assigned where there are no tracks
                if k >= 0 and np.linalg.norm(states[k].state_vector - true[within.index(j)].state_vector) < CUT_OFF_M:
                    self._switches += j in last and last[j] != numbers[k]
                    last[j] = numbers[k]

    @property
    def row(self) -> str:
        """As a row of the table."""
        gospa, ospa, *squares = np.array(self._rows).mean(axis=0)
        parts = " | ".join(f"{math.sqrt(square):.2f}" for square in squares)
        return f"{gospa:.3f} | {ospa:.3f} | {parts} | {self._switches}"


def main() -> None:
    """Tracks and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, metavar="FOLDER", help="recordings of one flight")
    print("flight, tracker | GOSPA | OSPA | localisation | missed | false | switches")
    for folder in parser.parse_args().recordings:
        scores = {kind: Scores() for kind in ("flockd", "GNN", "JPDA", "GM-PHD")}
        for path in sorted(folder.glob("*.mcap")):
            steps = steps_of(path)
            for kind, score in scores.items():
                own = {"flockd": by_flockd, "GM-PHD": by_gm_phd}
                score.add(steps, own[kind](steps) if kind in own else by_stone_soup(kind, steps))
        for kind, score in scores.items():
            print(f"{folder}, {kind} | {score.row}")


if __name__ == "__main__":
    main()
