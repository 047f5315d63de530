"""Flies a simulated flock for people who watch and disturb it, until they have seen enough: nothing is kept."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import ExitStack

from flockd.core.choices import SimulatedPerception
from flockd.sim.flock.control_loop import ControlLoop
from flockd.sim.flock.exact_states import start_yaw
from flockd.sim.flock.live_controls import LiveControls
from flockd.sim.flock.pilot_pool import PilotPool
from flockd.sim.flock.shown_flock import ShownFlock
from flockd.sim.flock.swarm import ExactStatePilots, VisionPilots
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.vehicles import Vehicles


def fly_live(
    scenario: ScenarioConfig,
    shown: ShownFlock,
    controls: LiveControls,
    *,
    perception: SimulatedPerception = "learned",
    swap: frozenset[str] = frozenset(),
    gated: bool = True,
    preparing: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Flies a scenario, beyond its end, and again from the beginning where that is asked for.

    Until KeyboardInterrupt. The arguments are those of `flockd.sim.flock.swarm.fly`; `controls` give the pace.
    """
    with ExitStack() as stack:
        pilots: ExactStatePilots | VisionPilots
        if perception == "truth":
            pilots = ExactStatePilots(scenario, shown, gated=gated)
        else:
            pool = stack.enter_context(PilotPool(scenario, swap, None))
            pilots = VisionPilots(scenario, pool, shown, (), None, preparing)
        while True:
            controls.begin()
            shown.begin_again()
            pilots.begin_again()
            _fly_once(scenario, pilots, shown, controls, gated=gated)


def _fly_once(
    scenario: ScenarioConfig,
    pilots: ExactStatePilots | VisionPilots,
    shown: ShownFlock,
    controls: LiveControls,
    *,
    gated: bool,
) -> None:
    """Until another flight is to begin."""
    loop = ControlLoop(scenario, gated=gated)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle, yaw_rad=start_yaw(scenario), seed=scenario.seed)
    for step in itertools.count():
        time_s = step * scenario.drone.step_s
        if not controls.wait(time_s):
            return
        disturbed = controls.disturbed
        vehicles.disturb(disturbed)
        shown.disturb(disturbed)
        commands = pilots.step(step, time_s, vehicles, None, pictured=False, disturbed=disturbed)
        shown.take_requests(time_s, loop, vehicles)
        loop.fly(time_s, vehicles, commands, disturbed)
        shown.show_flight(time_s, loop)
