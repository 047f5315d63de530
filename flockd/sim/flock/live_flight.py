"""Flies a simulated flock for people who watch and disturb it, until Ctrl-C: nothing is kept but a film."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

from flockd.fleet.simulation import SimulationMessage, checked_control
from flockd.onboard.daemon.operator_orders import OrderChecks
from flockd.onboard.telemetry.order_messages import parse_ask
from flockd.onboard.telemetry.topics import AnswerMessage
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.flock.control_loop import ControlLoop
from flockd.sim.flock.exact_states import vehicles_of
from flockd.sim.flock.flight_film import FlightFilm
from flockd.sim.flock.flock_telemetry import FlockTelemetry
from flockd.sim.flock.pilots import Pilots
from flockd.sim.flock.swarm import ExactStatePilots, VisionPilots, fly_commands
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.vehicles import UNDISTURBED, Disturbances

_REACHED_OVER_S = 4.0
_LONGEST_WAIT_S = 0.2
"""Longest single wait, so that Ctrl-C is noticed."""


class LiveControls:
    """Pace and disturbances of a live simulation, whose loop waits here before each step."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        identity: str,
        *,
        by_sight: bool,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[threading.Condition, float], object] = threading.Condition.wait,
    ) -> None:
        """``identity``: that of all its drones; ``by_sight``: whether they fly by sight; ``clock``: monotonic seconds;
        ``wait``: waits for a change, for so many seconds at most."""
        self._scenario, self._identity, self._clock, self._wait_on = scenario, identity, clock, wait
        self._by_sight = by_sight
        self._checks = OrderChecks(identity, time.monotonic)
        self._changed = threading.Condition()
        self._disturbed = UNDISTURBED
        self._paused = self._restart = False
        self._speed, self._flight, self._time_s = 1.0, 0, 0.0
        self._due: tuple[float, float] | None = None
        """A time of the flight, and when it is due on the clock; None: with the next step."""
        self._steps: deque[tuple[float, float]] = deque()
        """Of the last seconds without a pause: when on the clock, and the time of the flight."""

    @property
    def disturbed(self) -> Disturbances:
        """The present disturbances."""
        with self._changed:
            return self._disturbed

    def begin(self) -> None:
        """Begins a flight, the first or another one after a restart: at the same pace, without disturbances."""
        with self._changed:
            self._flight += 1
            self._time_s, self._restart, self._paused = 0.0, False, False
            self._disturbed = UNDISTURBED
            self._forget_pace()

    def wait(self, time_s: float) -> bool:
        """Waits until a time of the flight is due; False: the flight is over, as another one is to begin.

        A delay is not made up for: a late step is due at once, and the following ones at their usual intervals.
        """
        with self._changed:
            while not self._restart:
                left_s = self._left_s(time_s)
                if left_s <= 0.0:
                    self._note(time_s)
                    return True
                self._wait_on(self._changed, min(left_s, _LONGEST_WAIT_S))
            return False

    def reply(self, last: str, payload: bytes) -> Mapping[str, object]:
        """The reply to a query of the simulator; ``last`` is `state`, `time` or the name of a control."""
        match last:
            case "state":
                return {**self.state()}
            case "time":
                return {"time_s": time.monotonic(), "wall_s": time.time(), "identity": self._identity}
        return {**self.ask(last, payload)}

    def ask(self, control: str, payload: bytes) -> AnswerMessage:
        """The answer to a control."""
        try:
            ask = parse_ask(payload)
            given = checked_control(control, ask["order"])
            fault = self._checks.fault(control, ask)
            if fault is not None:
                return AnswerMessage(accepted=False, sentence=fault)
            with self._changed:
                sentence = self._done(control, given)
                self._changed.notify_all()
        except ValueError as error:
            return AnswerMessage(accepted=False, sentence=str(error))
        return AnswerMessage(accepted=True, sentence=sentence)

    def state(self) -> SimulationMessage:
        """Time, pace and disturbances of the simulation, as the fleet page shows them."""
        with self._changed:
            gust_m_s = self._disturbed.gust_m_s
            off: dict[str, list[str]] = {}
            for drone, camera in sorted(self._disturbed.cameras_off):
                off.setdefault(_name(drone), []).append(camera)
            return SimulationMessage(
                identity=self._identity,
                by_sight=self._by_sight,
                flight=self._flight,
                time_s=self._time_s,
                paused=self._paused,
                speed=self._speed,
                speed_reached=self._speed_reached(),
                gust_m_s=self._scenario.vehicle.gust_m_s if gust_m_s is None else gust_m_s,
                cameras_off=off,
                removed=[_name(drone) for drone in sorted(self._disturbed.removed)],
            )

    def _done(self, control: str, given: Mapping[str, object]) -> str:
        """Obeys a control; returns a sentence of what was done. Raises ValueError if it cannot be done."""
        match control, given:
            case "pause", _:
                self._paused = True
                self._forget_pace()
                return "the simulation stands still"
            case "go_on", _:
                self._paused = False
                return "the simulation goes on"
            case "restart", _:
                self._restart = True
                return "the flight begins again"
            case "speed", {"factor": float(factor)}:
                self._speed = factor
                self._forget_pace()
                return f"the simulation is to pass {factor:g} times as fast as real time"
            case "gusts", {"gust_m_s": float(gust_m_s)}:
                self._disturbed = replace(self._disturbed, gust_m_s=gust_m_s)
                return f"gusts of {gust_m_s:g} m/s blow from the next step on"
            case "camera", {"drone": str(drone), "camera": str(camera), "works": bool(works)}:
                return self._switch(drone, camera, works=works)
            case _:
                number = self._number(drone := str(given["drone"]))
                self._disturbed = replace(self._disturbed, removed=self._disturbed.removed | {number})
                return f"{drone} is taken out of the world"

    def _switch(self, drone: str, camera: str, *, works: bool) -> str:
        cameras = [one.name for one in self._scenario.drone.rig.cameras]
        if camera not in cameras:
            raise ValueError(f"{drone} has no camera {camera!r:.40}; it has {', '.join(cameras)}")
        one = frozenset({(self._number(drone), camera)})
        off = self._disturbed.cameras_off
        self._disturbed = replace(self._disturbed, cameras_off=off - one if works else off | one)
        return f"the camera {camera} of {drone} delivers {'images again' if works else 'no images any more'}"

    def _number(self, drone: str) -> int:
        """Counted from 0, of one that is there and that flockd flies."""
        numbers = {_name(i): i for i, one in enumerate(self._scenario.vehicles) if not one.by_hand}
        number = numbers.get(drone)
        if number is None or number in self._disturbed.removed:
            raise ValueError(f"there is no drone {drone!r:.40} in this simulation")
        return number

    def _left_s(self, time_s: float) -> float:
        """Until a step is due, on the clock."""
        return _LONGEST_WAIT_S if self._paused else self._due_s(time_s) - self._clock()

    def _due_s(self, time_s: float) -> float:
        """When a time of the flight is due on the clock; minus infinity: at once."""
        return -math.inf if self._due is None else self._due[1] + (time_s - self._due[0]) / self._speed

    def _note(self, time_s: float) -> None:
        """A step begins."""
        now_s, due_s = self._clock(), self._due_s(time_s)
        # A little late, as sleeping always is, does not move what follows.
        self._due = time_s, now_s if now_s - due_s > _LONGEST_WAIT_S else due_s
        self._time_s = time_s
        self._steps.append((now_s, time_s))
        while len(self._steps) > 2 and self._steps[1][0] < now_s - _REACHED_OVER_S:
            self._steps.popleft()

    def _forget_pace(self) -> None:
        self._due = None
        self._steps.clear()

    def _speed_reached(self) -> float | None:
        if len(self._steps) < 2:
            return None
        (first_s, from_s), (last_s, to_s) = self._steps[0], self._steps[-1]
        return (to_s - from_s) / max(last_s - first_s, 1e-6)


def _name(drone: int) -> str:
    return f"drone{drone + 1}"


def fly_live(
    scenario: ScenarioConfig,
    shown: FlockTelemetry,
    controls: LiveControls,
    eyes: tuple[CameraSimulator, Pilots] | None,
    *,
    gated: bool = True,
    film: FlightFilm | None = None,
) -> None:
    """Flies a scenario, beyond its end, and again from the beginning when a person restarts it.

    Until KeyboardInterrupt. `controls` give the pace; `eyes` are those of `eyes_of`, None on exact states.
    """
    while True:
        controls.begin()
        shown.begin_again()
        pilots: ExactStatePilots | VisionPilots = ExactStatePilots(scenario, shown, gated=gated)
        if eyes is not None:
            pilots = VisionPilots(scenario, *eyes, shown)
        loop, vehicles = ControlLoop(scenario, gated=gated), vehicles_of(scenario)
        step = 0
        while controls.wait(time_s := step * scenario.drone.step_s):
            disturbed = controls.disturbed
            vehicles.disturb(disturbed)
            shown.disturb(disturbed)
            commands = pilots.step(step, time_s, vehicles, None, pictured=False, disturbed=disturbed)
            if film is not None:
                film.add(time_s, vehicles.position, disturbed.removed)
            fly_commands(commands, time_s, loop, vehicles, shown, disturbed)
            step += 1
