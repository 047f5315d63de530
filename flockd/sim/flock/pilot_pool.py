"""The pilots of all drones that flockd flies, stepped side by side."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Self

from flockd.core.messages import FrameSet, MissionOrder, PilotOutput, VehicleState
from flockd.core.side_process import SideProcess
from flockd.flight.perception import ImageNetworks, load_networks
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.review.flight_log.key_frames import KeyFrame, capture
from flockd.sim.flock.truth_perception import RenderTruth, TruthPerception
from flockd.sim.scenario import ScenarioConfig

if TYPE_CHECKING:  # a process of pilots does not load the renderer, unless truths need it
    from flockd.sim.flock.truth_perception import RenderTruth, TruthPerception

Swap = Callable[[ImageNetworks], "TruthPerception"]
"""Puts the truth in the place of some networks."""


@dataclass(frozen=True, eq=False)
class Stepped:
    """What a drone's pilot did in a step."""

    output: PilotOutput
    key_frames: Sequence[KeyFrame]
    """What it worked with, at half size; empty where that was not asked for, or where it saw nothing."""


class Pilots:
    """Pilots that share their networks and nothing else."""

    def __init__(self, scenario: ScenarioConfig, drones: Sequence[int], swap: Swap | None) -> None:
        """Pilots of ``drones``, counted from 0. Raises ModelError."""
        learned = load_networks(scenario.drone.perception)
        self._truths = {} if swap is None else {i: swap(learned) for i in drones}
        self._scenario, self._learned = scenario, learned
        self._pilots = {i: self._pilot(i) for i in drones}

    def __call__(
        self,
        drone: int,
        frames: FrameSet,
        vehicle: VehicleState,
        truth: RenderTruth | None,
        pictured: bool,
        order: MissionOrder | None = None,
        begins: bool = False,
    ) -> Stepped:
        """One step of one drone, with an operator's order; ``begins``: of a new pilot, which knows of nothing before.

        ``truth`` is what its frames show, for a swap; ``pictured``: with its key frames.
        """
        if truth is not None:
            self._truths[drone].show(truth)
        if begins:
            self._pilots[drone] = self._pilot(drone)
        trace = StepTrace() if pictured else None
        output = self._pilots[drone].step(frames, vehicle, trace, order)
        seen = [] if trace is None else capture(trace, output, drone)
        return Stepped(output, [frame.at_half_size() for frame in seen])

    def _pilot(self, drone: int) -> FlockPilot:
        networks = self._truths.get(drone, self._learned)
        return FlockPilot(self._scenario.drone_of(drone), networks, stopwatch=time.perf_counter)


class PilotPool:
    """Between ``__enter__`` and ``__exit__``. Pilots share nothing but networks, so their order does not matter.

    Each process steps its drones one after the other, as their images come, while the next ones are drawn.
    """

    def __init__(self, scenario: ScenarioConfig, swap: frozenset[str], processes: int | None) -> None:
        """In as many ``processes``; None: as many as there are processors. Never more than drones.

        1: in this one, beside the caller; 0: on the caller's thread.
        """
        self.drones = tuple(i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.by_hand)
        """Counted from 0."""
        self.on_this_thread = processes == 0
        count = min(len(self.drones), (os.cpu_count() or 1) if processes is None else max(processes, 1))
        self._shares = [self.drones[first::count] for first in range(count)]
        self._scenario = scenario
        self._swap: Swap | None = None
        if swap:
            from flockd.sim.flock.truth_perception import TruthPerception  # noqa: PLC0415 - see above

            self._swap = partial(TruthPerception, swap=swap)
        self._processes: list[SideProcess] = []
        self._here: Pilots | None = None
        self._stack = ExitStack()
        self._threads = [ThreadPoolExecutor(1, thread_name_prefix="pilots") for _ in self._shares]

    def __enter__(self) -> Self:
        """Starts the processes, which load their networks while the caller goes on."""
        with ExitStack() as stack:
            for share in self._shares if len(self._shares) > 1 else ():
                names = ", ".join(f"drone{drone + 1}" for drone in share)
                process = SideProcess(f"flew {names}", Pilots, self._scenario, share, self._swap)
                self._processes.append(stack.enter_context(process))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        for thread in self._threads:
            thread.shutdown()

    def wait_until_ready(self) -> None:
        """Until all networks are loaded. Raises ModelError, and UnavailableError when a process has ended."""
        if not self._processes:
            self._here = Pilots(self._scenario, self.drones, self._swap)
        for process in self._processes:
            process.wait_until_ready()

    def step(
        self,
        drone: int,
        frames: FrameSet,
        vehicle: VehicleState,
        truth: RenderTruth,
        *,
        pictured: bool,
        order: MissionOrder | None = None,
        begins: bool = False,
    ) -> Future[Stepped]:
        """Steps a drone's pilot, see `Pilots`; the result is there once the drone's process has come to it."""
        place = self.drones.index(drone) % len(self._shares)
        pilots: Callable[..., Stepped] = self._here or self._processes[place].ask
        inputs = (drone, frames, vehicle, truth if self._swap else None, pictured, order, begins)
        if not self.on_this_thread:
            return self._threads[place].submit(pilots, *inputs)
        stepped: Future[Stepped] = Future()
        stepped.set_result(pilots(*inputs))
        return stepped
