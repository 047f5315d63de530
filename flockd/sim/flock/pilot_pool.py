"""The pilots of all drones that flockd flies, stepped side by side."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import TYPE_CHECKING, Self

from flockd.core.errors import UnavailableError
from flockd.core.messages import FrameSet, MissionOrder, PilotOutput, VehicleState
from flockd.flight.perception import ImageNetworks, load_networks
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.review.flight_log.key_frames import KeyFrame, capture
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.sitl.bound_to_parent import bind

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


_HERE: list[Pilots] = []
"""Those of a process that has no others' work."""


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Processes that start here do not hear Ctrl-C, which is for the simulator. For the main thread."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _load(scenario: ScenarioConfig, drones: Sequence[int], swap: Swap | None) -> None:
    _HERE.append(Pilots(scenario, drones, swap))


def _step(*inputs: object) -> Stepped:
    return _HERE[0](*inputs)  # type: ignore[arg-type]


class PilotPool:
    """Between ``__enter__`` and ``__exit__``. Pilots share nothing but networks, so their order does not matter.

    Each process steps its drones one after the other, as their images come, while the next ones are drawn.
    """

    def __init__(self, scenario: ScenarioConfig, swap: frozenset[str], processes: int | None) -> None:
        """In as many ``processes``; None: as many as there are processors. Never more than drones.

        1 and 0: in this one.
        """
        self.drones = tuple(i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.by_hand)
        """Counted from 0."""
        count = min(len(self.drones), (os.cpu_count() or 1) if processes is None else max(processes, 1))
        self._shares = [self.drones[first::count] for first in range(count)]
        self._scenario = scenario
        self._swap: Swap | None = None
        if swap:
            from flockd.sim.flock.truth_perception import TruthPerception  # noqa: PLC0415 - see above

            self._swap = partial(TruthPerception, swap=swap)
        self._executors: list[ProcessPoolExecutor] = []
        self._loaded: list[Future[None]] = []
        self._here: Pilots | None = None

    def __enter__(self) -> Self:
        """Starts the processes, which load their networks while the caller goes on. For the main thread."""
        for share in self._shares if len(self._shares) > 1 else ():
            executor = ProcessPoolExecutor(1, get_context("spawn"), initializer=bind, initargs=(os.getpid(),))
            self._executors.append(executor)
            with _deaf_children():
                self._loaded.append(executor.submit(_load, self._scenario, share, self._swap))
        return self

    def __exit__(self, *_: object) -> None:
        for executor in self._executors:
            executor.shutdown(cancel_futures=True)

    def wait_until_ready(self) -> None:
        """Until all networks are loaded. Raises ModelError, and UnavailableError when a process has ended."""
        if len(self._shares) == 1:
            self._here = Pilots(self._scenario, self.drones, self._swap)
        for drone, loaded in zip(self.drones, self._loaded, strict=False):
            with self._named(drone):
                loaded.result()

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
        """Steps a drone's pilot, see `Pilots`; `stepped` waits until the drone's process has come to it."""
        inputs = (drone, frames, vehicle, truth if self._swap else None, pictured, order, begins)
        if self._here is not None:
            done: Future[Stepped] = Future()
            done.set_result(self._here(*inputs))
            return done
        with self._named(drone):
            return self._executors[self._place(drone)].submit(_step, *inputs)

    def stepped(self, drone: int, stepping: Future[Stepped]) -> Stepped:
        """What its pilot did. Raises UnavailableError when its process has ended."""
        with self._named(drone):
            return stepping.result()

    def _place(self, drone: int) -> int:
        return self.drones.index(drone) % len(self._shares)

    @contextmanager
    def _named(self, drone: int) -> Iterator[None]:
        try:
            yield
        except BrokenProcessPool:
            flew = ", ".join(f"drone{one + 1}" for one in self._shares[self._place(drone)])
            fix = "if nobody ended it, free some memory, and try again"
            raise UnavailableError(f"the process that flew {flew} has ended; {fix}") from None
