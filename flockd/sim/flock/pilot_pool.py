"""The pilots of all drones that flockd flies, stepped side by side."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from types import TracebackType
from typing import Self

from flockd.core.messages import FrameSet, MissionOrder, VehicleState
from flockd.core.side_process import SideProcess
from flockd.sim.flock.pilots import Pilots, Stepped
from flockd.sim.flock.truth_perception import RenderTruth, TruthPerception
from flockd.sim.scenario import ScenarioConfig


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
        self._swap = partial(TruthPerception, swap=swap) if swap else None
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
