"""Builds a flight log step by step, in the simulator or from recordings, and matches estimates to the truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from flockd.core.messages import BoolArray, FloatArray, MissionStatus, PilotOutput
from flockd.review.flight_log.log import SHAPES, FlightLog, shape_of
from flockd.review.flight_log.metadata import FlightMetadata, LearnedSize

ASSOCIATED_M = 3.0
"""Largest distance between a track and the drone that it is of: so wide that a large error counts as an error, and not
as a false neighbour."""


class FlightLogBuilder:
    """Builds the log of ``drones`` drones whose steps begin at ``times`` (S,) s; NaN where nothing is added."""

    def __init__(self, times: FloatArray, drones: int) -> None:
        self._drones = drones
        self._rows = {
            name: np.full(shape_of(name, len(times), drones), np.nan)
            for name in SHAPES.keys() - {"clearance", "truth_position", "truth_velocity"}
        }
        self._rows["time_s"], self._rows["false_tracks"] = times, np.zeros((len(times), drones), np.int64)
        self._false_so_far: list[set[int]] = [set() for _ in range(drones)]
        self._tracked: list[tuple[float, ...]] = []
        self._stages: dict[str, list[float]] = {}
        self._mission_over = [False] * drones
        self._sizes: dict[int, LearnedSize] = {}

    def add_truth(self, step: int, position: FloatArray, velocity: FloatArray, R_ned_body: FloatArray) -> None:
        """True states of all drones as a step begins: (N, 3) m and (N, 3) m/s NED, (N, 3, 3).

        Call it before `add_output` of the same step, which matches estimates to it.
        """
        for name, state in (("position", position), ("velocity", velocity), ("attitude", R_ned_body)):
            self._rows[name][step] = state

    @property
    def true_path(self) -> tuple[FloatArray, FloatArray]:
        """True positions (S, N, 3) m and velocities (S, N, 3) m/s NED: the companion of a flight on exact states."""
        return self._rows["position"], self._rows["velocity"]

    def add_missions(
        self, step: int, desired: FloatArray, missions: Sequence[MissionStatus], homes: FloatArray | None = None
    ) -> None:
        """What each drone's mission wants, (n, 2) m/s, and how far it is.

        `homes` (n, 2) are metres north and east from which the drones' goals count; None: all from the origin. A drone
        whose mission ended in an earlier step has no goal. Call it in order of the steps.
        """
        same = (desired == desired[0]).all()
        self._rows["desired"][step] = desired[0] if same else desired.mean(axis=0)
        goals = [
            tuple(np.round(mission.goal + (0.0 if homes is None else homes[i]), 3).tolist())
            for i, mission in enumerate(missions)
            if mission.goal is not None and not self._mission_over[i]
        ]
        for i, mission in enumerate(missions):
            self._mission_over[i] |= mission.takeover is not None
        if goals:
            self._rows["goal"][step] = Counter(goals).most_common(1)[0][0]

    def add_exact_states(
        self, step: int, i: int, others: BoolArray, relative: FloatArray, velocities: FloatArray, command: FloatArray
    ) -> None:
        """What drone ``i`` was given of the others in a flight with exact states, and its command.

        ``others`` (N,) is true for those that ``relative`` (N - 1, 3) m NED are of; ``velocities`` (N, 3) m/s NED.
        """
        self._rows["neighbour_position"][step, i, others] = relative
        self._rows["neighbour_velocity"][step, i, others] = velocities[others]
        self._rows["own_velocity_estimate"][step, i] = velocities[i]
        self._rows["command_velocity"][step, i] = command

    def add_output(self, step: int, i: int, output: PilotOutput, stages_ms: Mapping[str, float]) -> None:
        """What the pilot of drone ``i`` estimated and commanded."""
        if np.isfinite(self._rows["position"][step]).all():
            self._match(step, i, output)
        for neighbour in output.neighbours:
            if neighbour.confirmed:
                self._tracked.append((float(step), float(i), float(neighbour.track), *neighbour.position.tolist()))
        ego = output.ego_motion
        if ego is not None:
            self._rows["ego_rotation"][step, i], self._rows["ego_translation"][step, i] = ego.rotation, ego.translation
        if output.velocity is not None:
            self._rows["own_velocity_estimate"][step, i] = output.velocity
        self._rows["command_velocity"][step, i] = output.command.velocity
        size = output.size
        if size is not None and size.size_m is not None and size.sigma is not None:
            since_s = self._sizes[i].since_s if i in self._sizes else float(self._rows["time_s"][step])
            self._sizes[i] = LearnedSize(since_s=since_s, size_m=size.size_m, sigma=size.sigma)
        for stage, ms in stages_ms.items():
            self._stages.setdefault(stage, []).append(ms)

    def _match(self, step: int, i: int, output: PilotOutput) -> None:
        """Match confirmed tracks to true drones; those near none are false."""
        others = [j for j in range(self._drones) if j != i]
        true = self._rows["position"][step, others] - self._rows["position"][step, i]
        confirmed = [n for n in output.neighbours if n.confirmed]
        tracked = np.array([n.position for n in confirmed]).reshape(-1, 3)
        for estimate, truth in match_neighbours(tracked, true):
            self._rows["neighbour_position"][step, i, others[truth]] = confirmed[estimate].position
            self._rows["neighbour_velocity"][step, i, others[truth]] = confirmed[estimate].velocity
        associated = {estimate for estimate, _ in match_neighbours(tracked, true, ASSOCIATED_M)}
        false = {n.track for k, n in enumerate(confirmed) if k not in associated} - self._false_so_far[i]
        self._false_so_far[i] |= false
        self._rows["false_tracks"][step, i] = len(false)

    def cut(self, steps: int) -> None:
        """Keeps only the first ``steps`` steps, of a flight that ended there."""
        self._rows = {name: rows[:steps] for name, rows in self._rows.items()}
        self._tracked = [row for row in self._tracked if row[0] < steps]

    def build(self, metadata: FlightMetadata, companion: tuple[FloatArray, FloatArray] | None) -> FlightLog:
        """The log, with positions and velocities (S, N, 3) of the companion with exact states, if there is one."""
        truth_position, truth_velocity = companion or np.zeros((2, 0, self._drones, 3))
        return FlightLog(
            **self._rows,
            truth_position=truth_position,
            truth_velocity=truth_velocity,
            stages_ms={stage: np.array(ms) for stage, ms in self._stages.items()},
            metadata=metadata.model_copy(update={"sizes": self._sizes}),
            tracked=np.array(self._tracked).reshape(-1, 6),
        )


def match_neighbours(estimated: FloatArray, true: FloatArray, within_m: float = 1.0) -> list[tuple[int, int]]:
    """Greedy assignment of estimates to drones: (estimate, drone) index pairs, one to one, the nearest pair first.

    `estimated` (m, 3) and `true` (n, 3) are metres relative to one observer, which is not among them. No pair is
    farther apart than `within_m` or a quarter of the true range, whichever is more.
    """
    distances = np.linalg.norm(estimated[:, None] - true[None], axis=2)
    allowed = np.maximum(within_m, 0.25 * np.linalg.norm(true, axis=1))
    pairs: list[tuple[int, int]] = []
    for flat in np.argsort(distances, axis=None, kind="stable"):
        estimate, drone = divmod(int(flat), len(true))
        taken = any(estimate == e or drone == d for e, d in pairs)
        if not taken and distances[estimate, drone] <= allowed[drone]:
            pairs.append((estimate, drone))
    return sorted(pairs)
