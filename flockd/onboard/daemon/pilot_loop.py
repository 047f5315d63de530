"""The pilot's loop: takes the newest frames, runs a step of the pilot, and keeps the result."""

from __future__ import annotations

import asyncio
import bisect
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flockd.core import services
from flockd.core.config import DroneConfig
from flockd.core.messages import (
    FloatArray,
    FrameSet,
    LearnedSize,
    MissionOrder,
    Neighbour,
    PilotOutput,
    ReasonKind,
    VehicleState,
)
from flockd.flight.geometry import rotation_from_vector, vector_from_rotation
from flockd.flight.pilot import FlockPilot
from flockd.onboard.daemon.watched_networks import NetworkStuckError, WatchedNetworks
from flockd.onboard.sources import FrameSource
from flockd.onboard.worker import BusyError, LateError, Worker

FRAME_WAIT_S = 0.1
FRAME_DEADLINE_S = 5.0
"""Deadline to decode one frame set."""
STEP_DEADLINE_S = 30.0
"""Deadline of a whole step; its networks have earlier ones, and the drone is handed over long before."""
LEAVE_S = 0.7
STEPS_REMEMBERED = 20
SEEN_PROBABILITY = 0.9
"""Existence probability after two detections that agree: company for a drone, though flocking waits for a third."""
MAX_UNEXPECTED = 3
"""Steps in a row with an unexpected error after which the loop ends and the drone holds."""


@dataclass(frozen=True, eq=False)
class StepResult:
    """The output of one step, and the time of its images on the daemon's clock, from which all ages count."""

    time_s: float
    output: PilotOutput
    flight: int
    """Number of the flight whose pilot computed it."""
    number: int
    """Number of the step, from 1 for the first of its pilot."""


class StepsFailedError(Exception):
    """Too many steps in a row ended in an unexpected error."""


OnStep = Callable[[FrameSet, VehicleState, PilotOutput, MissionOrder | None], None]


class PilotLoop:
    """Steps the pilot at its own rate; the source drops frames that come in between."""

    def __init__(
        self,
        config: DroneConfig,
        source: FrameSource,
        networks: WatchedNetworks,
        vehicle_at: Callable[[float], VehicleState | None],
        on_step: OnStep,
        log_event: Callable[[str], None],
        clock: Callable[[], float],
    ) -> None:
        """``vehicle_at`` gives the vehicle's state at a frame's time; None before any is known."""
        self._config, self._source, self._networks = config, source, networks
        self._vehicle_at, self._on_step, self._log_event, self._clock = vehicle_at, on_step, log_event, clock
        self._decoding = Worker("decoding")
        self._geometry = Worker("geometry")
        self._pilot: FlockPilot | None = None
        self._flight = self._begun = 0
        """Number of the flight, and number of pilots begun."""
        self._learned: LearnedSize | None = None
        self.learned_before: LearnedSize | None = None
        """The others' size with which the flight's pilot began."""
        self._failure: str | None = None
        self._unexpected = 0
        """Unexpected errors in a row."""
        self._reports = Reports()
        self._took_s: deque[float] = deque(maxlen=STEPS_REMEMBERED)
        self.frames: FrameSet | None = None
        """The newest frame set; None before the first."""
        self.newest: StepResult | None = None
        self.stepped: tuple[FrameSet, VehicleState, PilotOutput] | None = None
        """The newest result with the inputs of its step."""
        self.steps = 0
        self.failed = 0
        """Steps without a result because of a late network or an unexpected error."""
        self._ego_motion_s = 0.0
        """Time of the flight's newest step with an own motion, or of its first step."""
        self.noisy_images: Counter[str] = Counter()
        """Images that were not used, by camera."""
        self.neighbour_seen_s = -math.inf
        """When a neighbour was last seen, confirmed or nearly (`SEEN_PROBABILITY`)."""
        self.order: MissionOrder | None = None
        """An operator's order that no finished step has taken yet."""

    def begin_flight(self, number: int) -> None:
        """Uses a new pilot from the next step on: its time starts there, so that a recording can be replayed."""
        self._flight, self.learned_before = number, self._learned
        self._begun += 1
        self._pilot = self.order = None
        self._reports.begin()

    def take_order(self, order: MissionOrder) -> None:
        """Passes an operator's order to the next step."""
        self.order = order

    @property
    def ego_motion_age_s(self) -> float:
        """Time without own motion, as of the newest step."""
        return 0.0 if self.newest is None else self.newest.time_s - self._ego_motion_s

    def load(self) -> float:
        """95th percentile of the last steps' durations, over the permitted one."""
        return float(np.percentile(self._took_s, 95)) / self._config.step_s if self._took_s else 0.0

    async def run(self) -> None:
        """Steps until cancelled.

        Raises LateError if decoding or a step hangs, and StepsFailedError after some steps in a row with unexpected
        errors; a single one is counted, and the loop goes on.
        """
        assert self._config.source is not None
        source, due_s = self._config.source, self._clock()
        frame_period_s = 1.0 / min([camera.rate_hz for camera in source.cameras] or [source.shared_memory.rate_hz])
        while True:
            frames = await self._decoding.do(FRAME_DEADLINE_S, self._source.newest, FRAME_WAIT_S)
            if frames is None:
                continue
            self.frames = frames
            taken_s = self._clock()
            exposed_s = frames.time_s + self._config.rig.time_offset_s
            vehicle = self._vehicle_at(exposed_s)
            if vehicle is not None:
                on_our_clock = 0.0 <= taken_s - exposed_s <= HISTORY_S
                await self._step(taken_s, exposed_s if on_our_clock else taken_s, frames, vehicle)
            now = self._clock()
            due_s = max(due_s + self._config.step_s, now)
            await asyncio.sleep(due_s - frame_period_s - now)  # then the next frame comes when a step is due

    def leave(self) -> None:
        """Ends running work; takes up to two seconds, from any thread."""
        self._networks.leave()
        self._geometry.leave(LEAVE_S)
        self._decoding.leave(LEAVE_S)

    async def _step(self, taken_s: float, seen_s: float, frames: FrameSet, vehicle: VehicleState) -> None:
        begun, order = self._begun, self.order
        self.steps += 1
        try:
            pilot = self._pilot
            if pilot is None:
                pilot = await self._geometry.do(STEP_DEADLINE_S, self._new_pilot)
            output = await self._geometry.do(STEP_DEADLINE_S, pilot.step, frames, vehicle, None, order)
        except (LateError, BusyError):
            raise
        except Exception as error:  # noqa: BLE001 - an unexpected error costs one step
            self._note_failure(error)
            return
        finally:
            self._took_s.append(self._clock() - taken_s)
        if begun != self._begun:
            return  # a new pilot began meanwhile; this result is of the old one
        if self.order is order:
            self.order = None  # a failed step is not recorded: the next one takes the order again
        self._failure, self._unexpected = None, 0
        number = 1 if self._pilot is None or self.newest is None else self.newest.number + 1
        self._pilot, self._learned = pilot, pilot.learned
        self.newest = StepResult(seen_s, output, self._flight, number)
        self.stepped = frames, vehicle, output
        self._count(self.newest)
        for report in self._reports.update(output):
            self._log_event(report)
        self._on_step(frames, vehicle, output, order)

    def _new_pilot(self) -> FlockPilot:
        return FlockPilot(
            self._config,
            self._networks,
            stopwatch=time.perf_counter,
            learned=self.learned_before,
            flies=self._flight > 0,
        )

    def _note_failure(self, error: Exception) -> None:
        """Counts a failed step; an event for a new reason. Raises StepsFailedError after too many unexpected errors."""
        expected = isinstance(error, NetworkStuckError)
        why = str(error) if expected else f"{type(error).__name__}: {error}"
        self.failed += 1
        if why != self._failure:
            self._log_event(f"a step failed: {why}")
        self._failure = why
        self._unexpected += not expected
        if self._unexpected >= MAX_UNEXPECTED and not expected:
            raise StepsFailedError(f"{self._unexpected} steps in a row failed; the last with {why}") from error

    def _count(self, result: StepResult) -> None:
        if result.output.ego_motion is not None or result.number == 1:
            self._ego_motion_s = result.time_s
        self.noisy_images.update(result.output.noisy_cameras)
        self.neighbour_seen_s = max(self.neighbour_seen_s, last_seen_s(result.time_s, result.output.neighbours))


def last_seen_s(time_s: float, neighbours: Sequence[Neighbour]) -> float:
    """When one of the `neighbours` of the step at `time_s` was last seen, if it is confirmed or nearly."""
    return max(
        (time_s - n.unseen_s for n in neighbours if n.confirmed or n.existence_probability >= SEEN_PROBABILITY),
        default=-math.inf,
    )


class Reports:
    """Event sentences from outputs: faults that begin or end, and findings about cameras and sizes."""

    def __init__(self) -> None:
        self._faults: dict[str, ReasonKind] = {}
        """Faults of the step before, by their texts."""
        self.begin()

    def begin(self) -> None:
        """Starts anew, with a new pilot."""
        self._told, self._of_rig = set(self._faults), set[str]()

    def update(self, output: PilotOutput) -> list[str]:
        """The sentences for a step's output: once a flight for the rig, else at the beginning and end of a fault."""
        before, self._faults = self._faults, {one.text: one.kind for one in output.reasons if one.kind in _OVER}
        over = [
            f"{fault.partition(':')[0]}: {_OVER[kind]}"
            for fault, kind in before.items()
            if fault not in self._faults and (kind is ReasonKind.LENS or kind not in self._faults.values())
        ]
        rig = {one.text: one.text for one in output.reasons if one.kind is ReasonKind.RIG}
        told, size = {fault: fault for fault in self._faults} | rig, output.size
        if size is not None and size.weaves:
            told["weaves"] = "size: moves up and down to learn how large the others are"
        if size is not None and size.size_m is not None:
            found = f"{size.size_m:.2f} m large, +-{size.sigma:.0%}"
            told["found"] = (
                f"size: the others are {found}; ranges follow from it; measure them and write `perception.drone_size_m`"
            )
        begun = [text for what, text in told.items() if what not in self._told]
        self._of_rig |= set(rig)
        self._told = set(told) | self._of_rig
        return begun + over


_OVER = {ReasonKind.HEIGHT: "the range finder works again", ReasonKind.LENS: "its lens is clear again"}
"""Reported, after the fault's subject, when a fault has ended."""


HISTORY_S = services.VEHICLE_STATE.timeout


class VehicleHistory:
    """The vehicle's states of the last `HISTORY_S` seconds."""

    def __init__(self) -> None:
        self._states: deque[VehicleState] = deque()

    def add(self, state: VehicleState) -> None:
        """Adds the newest state; one that is not newer than the last is ignored."""
        if not self._states or state.time_s > self._states[-1].time_s:
            self._states.append(state)
        while self._states[-1].time_s - self._states[0].time_s > HISTORY_S:
            self._states.popleft()

    def at(self, time_s: float) -> VehicleState | None:
        """The state at that time, interpolated; the newest for a time on another clock; None before the first."""
        if not self._states:
            return None
        if not self._states[0].time_s - HISTORY_S <= time_s <= self._states[-1].time_s + HISTORY_S:
            return self._states[-1]
        later = bisect.bisect_left(self._states, time_s, key=lambda state: state.time_s)
        if later in (0, len(self._states)):
            return self._states[max(0, later - 1)]
        return _between(self._states[later - 1], self._states[later], time_s)

    def moved_since(self, time_s: float) -> FloatArray:
        """(3,) m NED: displacement since that time, by the vehicle's velocities; 0 if none are known.

        Positions of an autopilot jump when its estimator is reset; velocities hardly do.
        """
        then = self.at(time_s)
        states = [*([] if then is None else [then]), *(one for one in self._states if one.time_s > time_s)]
        known = [(one.time_s, one.velocity_ned) for one in states if one.velocity_ned is not None]
        moved = np.zeros(3)
        for (before_s, before), (after_s, after) in pairwise(known):
            moved += (after_s - before_s) * (before + after) / 2
        return moved


def _between(before: VehicleState, after: VehicleState, time_s: float) -> VehicleState:
    """Interpolated, with constant turn rate and velocity."""
    share = (time_s - before.time_s) / (after.time_s - before.time_s)
    turn = vector_from_rotation(before.R_ned_body.T @ after.R_ned_body)
    ranges = [one for one in (before.ground_range, after.ground_range) if one is not None]
    return VehicleState(
        time_s=time_s,
        R_ned_body=before.R_ned_body @ rotation_from_vector(share * turn),
        height_m=before.height_m + share * (after.height_m - before.height_m),
        velocity_ned=_between_vectors(before.velocity_ned, after.velocity_ned, share),
        position=_between_vectors(before.position, after.position, share),
        home_deg=after.home_deg,
        # The nearest in time: ranges jump at edges, so they are not interpolated.
        ground_range=min(ranges, key=lambda reading: abs(reading.time_s - time_s), default=None),
        turn_rate=turn / (after.time_s - before.time_s),
    )


def _between_vectors(before: FloatArray | None, after: FloatArray | None, share: float) -> FloatArray | None:
    """Interpolated; the later one if only that is known."""
    return after if before is None or after is None else before + share * (after - before)
