"""The pilots of some of the drones, whichever process they step in."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flockd.core.messages import FrameSet, MissionOrder, PilotOutput, VehicleState
from flockd.flight.perception import ImageNetworks, load_networks
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.review.flight_log.capture import capture
from flockd.review.flight_log.key_frames import KeyFrame
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
