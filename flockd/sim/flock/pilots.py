"""The pilots of all drones that flockd flies, stepped side by side."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from flockd.core.messages import FrameSet, MissionOrder, PilotOutput, VehicleState
from flockd.flight.perception import load_networks
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.review.flight_log.key_frames import KeyFrame, capture
from flockd.sim.flock.truth_perception import RenderTruth, TruthPerception
from flockd.sim.scenario import ScenarioConfig


@dataclass(frozen=True, eq=False)
class Stepped:
    """What a drone's pilot did in a step."""

    output: PilotOutput
    key_frames: Sequence[KeyFrame]
    """What it worked with, at half size; empty where that was not asked for, or where it saw nothing."""


class Pilots:
    """One a drone. They share their networks and nothing else, so that their order does not matter."""

    def __init__(self, scenario: ScenarioConfig, swap: frozenset[str], threads: int | None) -> None:
        """On ``threads``, while the next images are drawn; 0: on the calling one; None: as many as processors.

        ``swap``: see `flockd.sim.flock.swarm.fly`. Raises ModelError.
        """
        self.drones = tuple(i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.by_hand)
        """Counted from 0."""
        self._scenario, self._networks = scenario, load_networks(scenario.drone.perception)
        self._truths = {i: TruthPerception(self._networks, swap) for i in self.drones} if swap else {}
        count = os.cpu_count() if threads is None else threads
        self._executor = ThreadPoolExecutor(count, thread_name_prefix="pilot") if count else None
        self.begin_again()

    def begin_again(self) -> None:
        """New pilots, which know of nothing before."""
        self._pilots = {
            i: FlockPilot(self._scenario.drone_of(i), self._truths.get(i, self._networks), stopwatch=time.perf_counter)
            for i in self.drones
        }

    def step(
        self, drone: int, frames: FrameSet, vehicle: VehicleState, truth: RenderTruth, *, pictured: bool,
        order: MissionOrder | None = None,
    ) -> Future[Stepped]:  # fmt: skip
        """One step of one drone, with an operator's order.

        ``truth`` is what its frames show, for a swap; ``pictured``: with its key frames.
        """
        if self._executor is not None:
            return self._executor.submit(self._step, drone, frames, vehicle, truth, pictured, order)
        done: Future[Stepped] = Future()
        done.set_result(self._step(drone, frames, vehicle, truth, pictured, order))
        return done

    def _step(
        self, drone: int, frames: FrameSet, vehicle: VehicleState, truth: RenderTruth, pictured: bool,
        order: MissionOrder | None,
    ) -> Stepped:  # fmt: skip
        if drone in self._truths:
            self._truths[drone].show(truth)
        trace = StepTrace() if pictured else None
        output = self._pilots[drone].step(frames, vehicle, trace, order)
        seen = [] if trace is None else capture(trace, output, drone)
        return Stepped(output, [frame.at_half_size() for frame in seen])
