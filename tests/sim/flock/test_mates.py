"""One of five stops, alone and at once: its mates, who know it by tracks of made-up detections, keep 1 m apart.

Trackers take mates to fly on with the flock: one that stops is not found where it is looked for.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest

from flockd.core.config.mission import MissionParameters
from flockd.core.config.real_drone import safe_speeds
from flockd.core.messages import FloatArray
from flockd.flight.safety import Action, Decision, State
from flockd.sim.flock.control_loop import ControlLoop
from flockd.sim.flock.exact_states import ExactFlock
from flockd.sim.scenario import CameraFaultConfig, ScenarioConfig, StartConfig
from flockd.sim.vehicles.vehicles import GRAVITY_M_S2, Vehicles
from tests.sim.flock.test_encounters import ENCOUNTER

APART_M = 1.0
"""What fault 75 promises, at every instant."""
SPEED_M_S, SIDE_M = 2.0, 2.0
PLACES = {"the foremost": 0, "one beside": 1, "one of the last": 2, "another of the last": 3, "another beside": 4}
BEGINS_S, FLIES_S, STANDS_S = 5.0, 12.0, 3.0
PAIRS = np.triu_indices(5, 1)


class _Watched(Vehicles):
    """Notes places, (5, 3) m, and velocities, (5, 3) m/s, at 20 Hz."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        super().__init__(scenario.vehicles, scenario.vehicle, seed=scenario.seed, sensors=scenario.sensors)
        self.places, self.velocities = [self.position], [self.velocity]
        self.fallen: set[int] = set()
        """Whose motors have stopped: they fall, and lie where they hit the ground."""

    def step(
        self, setpoints: FloatArray, yaw_setpoints: FloatArray, interval_s: float, heights: FloatArray | None = None
    ) -> None:
        places, velocities = self.position, self.velocity
        super().step(setpoints, yaw_setpoints, interval_s, heights)
        for i in self.fallen:
            self.velocity[i] = velocities[i] + [0.0, 0.0, GRAVITY_M_S2 * interval_s]
            self.position[i] = places[i] + self.velocity[i] * interval_s
            if self.position[i, 2] >= 0.0:
                self.position[i, 2], self.velocity[i] = 0.0, 0.0
        self.places.append(self.position)
        self.velocities.append(self.velocity)

    def nearest_m(self) -> float:
        """How near any two have come."""
        places = np.array(self.places)
        return float(np.linalg.norm(places[:, PAIRS[0]] - places[:, PAIRS[1]], axis=2).min())


class _Flight:
    """A pentagon that flies north, each drone seen at 2 Hz and 0.3 s late. The first is foremost, 2 and 3 are last."""

    def __init__(
        self, range_error: float, seed: int, speed_m_s: float = SPEED_M_S, faults: Sequence[CameraFaultConfig] = ()
    ) -> None:
        mission = MissionParameters(kind="velocity", velocity_m_s=(speed_m_s, 0.0))
        radius_m = SIDE_M / (2 * math.sin(math.pi / 5))
        places = [(radius_m * math.cos(k * math.tau / 5), radius_m * math.sin(k * math.tau / 5)) for k in range(5)]
        vehicles = tuple(
            StartConfig(position_m=(*place, -5.0), velocity_m_s=(speed_m_s, 0.0), mission=mission) for place in places
        )
        assert ENCOUNTER.detections is not None
        detections = ENCOUNTER.detections.model_copy(update={"range_error": range_error})
        changes = {
            "vehicles": vehicles, "seed": seed, "latency_s": 0.3, "detections": detections, "faults": tuple(faults)
        }  # fmt: skip
        scenario = ENCOUNTER.model_copy(update=changes)
        self._flock, self.loop, self.vehicles = ExactFlock(scenario), ControlLoop(scenario), _Watched(scenario)
        self.time_s, self.step_s = 0.0, scenario.drone.step_s

    def fly(self, duration_s: float, steps_s: Iterator[float] | None = None) -> None:
        """With steps of these lengths, s, or as configured."""
        until_s = self.time_s + duration_s - 1e-6
        while self.time_s < until_s:
            step_s = self.step_s if steps_s is None else next(steps_s)
            self.loop._step_s = step_s
            for one in self._flock._tracked:
                one._step_s = step_s
            commands = self._flock.step(
                self.time_s, self.vehicles.position, self.vehicles.velocity, own=self.vehicles.known_velocity
            )
            self.loop.fly(self.time_s, self.vehicles, commands)
            self.time_s += step_s


def _hovers(flight: _Flight, one: int) -> None:
    """Its own gate brakes it, as hard as it may: 5 m/s^2."""
    decision = Decision(State.HOVER, Action.HOVER, ())
    flight.loop._drones[one].decide = lambda *_: decision  # type: ignore[method-assign]


def _is_taken_over(flight: _Flight, one: int) -> None:
    flight.loop.hold(one, flight.time_s, flight.vehicles)


def _lands(flight: _Flight, one: int) -> None:
    flight.loop._taken[one] = "land"


def _dies(flight: _Flight, one: int) -> None:
    flight.vehicles.fallen.add(one)


STOPS: dict[str, Callable[[_Flight, int], None]] = {
    "hovers": _hovers, "is taken over": _is_taken_over, "lands": _lands, "dies": _dies
}  # fmt: skip


@pytest.mark.fault("mate-stops")
@pytest.mark.parametrize(
    ("speed_m_s", "range_error", "seed"),
    [
        *((speed_m_s, 0.06, 1) for speed_m_s in (1.0, 2.0)),
        *(pytest.param(speed_m_s, 0.06, 1, marks=pytest.mark.slow) for speed_m_s in (0.5, 1.5, 3.0)),
        *(pytest.param(2.0, error, seed, marks=pytest.mark.slow) for error in (0.02, 0.06) for seed in (2, 3)),
    ],
)
def test_whichever_of_five_stops_its_mates_keep_a_metre_apart(
    speed_m_s: float, range_error: float, seed: int, record_property: Callable[[str, object], None]
) -> None:
    flight, nearest_m = _Flight(range_error, seed, speed_m_s), {}
    flight.fly(FLIES_S)
    flown_m_s = float(np.array(flight.vehicles.velocities)[round(BEGINS_S / 0.05) :, :, 0].mean())
    for (place, one), (stops, begin) in itertools.product(PLACES.items(), STOPS.items()):
        then = copy.deepcopy(flight)
        begin(then, one)
        then.fly(STANDS_S)
        assert np.hypot(*then.vehicles.known_velocity[one, :2]) < 0.4, "it has stopped, or swings back"
        nearest_m[f"{place} {stops}"] = then.vehicles.nearest_m()
    record_property("nearest_m", {name: round(metres, 2) for name, metres in nearest_m.items()})
    record_property("speed_m_s", round(flown_m_s, 2))
    assert min(nearest_m.values()) >= APART_M, nearest_m
    assert flown_m_s > 0.6 * speed_m_s, "where nobody stops they fly on"


@pytest.mark.parametrize(("share", "nearest_m"), [(0.7, 1.8), (1.0, 1.2), (1.3, 0.6), (2.0, -0.7)])
def test_one_that_learns_of_it_as_late_as_may_be_keeps_a_metre_up_to_the_safe_speed(
    share: float, nearest_m: float
) -> None:
    """Without tracker and gate: 3.5 m ahead, which are 9 % less, a mate stops by 5 m/s^2. A step and its time later a
    vehicle that answers as PX4's is told to brake as hard. The gate brakes softer, and expects it."""
    speed_m_s = share * safe_speeds(ENCOUNTER.drone)[0]
    start = StartConfig(position_m=(0.0, 0.0, -5.0), velocity_m_s=(speed_m_s, 0.0))
    vehicle, gaps_m = Vehicles((start,), ENCOUNTER.vehicle), []
    for time_s in np.arange(0.0, 6.0, 0.05):
        braked_s = min(time_s, speed_m_s / 5.0)
        gaps_m.append(0.91 * 3.5 + speed_m_s * braked_s - 2.5 * braked_s**2 - vehicle.position[0, 0])
        setpoint = max(speed_m_s - 5.0 * max(time_s - 1.0, 0.0), 0.0)
        vehicle.step(np.array([[setpoint, 0.0]]), np.zeros(1), 0.05)
    assert min(gaps_m) == pytest.approx(nearest_m, abs=0.1)
