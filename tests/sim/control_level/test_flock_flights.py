"""Flights at control level against one drone's law and the simulator's exact flights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flockd.core.errors import UsageError
from flockd.core.messages import FloatArray
from flockd.flight.flocking import FlockingLaw, FlockingParameters, WeightParameters
from flockd.flight.flocking.metrics import closest_distances, order, safety, union
from flockd.sim.control_level import fly_flocks
from flockd.sim.control_level.flock_figures import orders
from flockd.sim.control_level.flock_flights import FlockFlights
from flockd.sim.flock.exact_states import fly_exact_states
from flockd.sim.flock.start import scattered, with_drones
from flockd.sim.scenario import ScenarioConfig
from tests.sim.control_level.flocks import SHIPPED, flock

UNIFORM = WeightParameters(kind="uniform")


def _seeded(scenario: ScenarioConfig, seed: int) -> ScenarioConfig:
    return scattered(scenario.model_copy(update={"seed": seed}), 0.5)


def _flown(flights: FlockFlights) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities (S, flights, n, 3) as each step begins."""
    states = []
    for step in range(flights.steps):
        states.append(flights.states.copy())
        flights.step(step)
    moved = np.array(states).transpose(0, 2, 3, 1)
    return moved[..., :3], moved[..., 3:]


@pytest.mark.parametrize(
    "parameters",
    [
        FlockingParameters(),
        FlockingParameters(weight=UNIFORM),
        FlockingParameters(weight=WeightParameters(kind="nearest", nearest=3)),
        FlockingParameters(weight=WeightParameters(kind="nearest", nearest=12), observation_distance_m=6.0),
        FlockingParameters(weight=UNIFORM, separation_distance_m=4.0, observation_distance_m=3.0),
        FlockingParameters(
            weight=WeightParameters(kind="nearest", nearest=2), separation_distance_m=4.0, observation_distance_m=3.0
        ),
        FlockingParameters(weight=UNIFORM, cohesion=0.3, alignment=0.7, separation=2.0, velocity=0.5, own_weight=3.0),
    ],
)
@pytest.mark.parametrize(("drones", "spread_m"), [(2, 1.0), (7, 3.0), (60, 1.5), (60, 12.0), (40, 200.0)])
def test_each_drone_accelerates_as_the_law_says(parameters: FlockingParameters, drones: int, spread_m: float) -> None:
    scenario = flock(drones=drones)
    drone = scenario.drone.model_copy(update={"flocking": parameters})
    flights = FlockFlights([scenario.model_copy(update={"drone": drone})] * 2)
    random = np.random.default_rng(drones)
    flights.states[:] = random.normal(0.0, spread_m, flights.states.shape)
    flights.states[:2, 1, 1] = flights.states[:2, 1, 0] + [0.0, 4e-4]  # nearer than the law's pole
    flights.perceive(0)
    following = parameters.velocity * parameters.own_weight
    law = FlockingLaw(parameters)
    for flight in range(2):
        x, v = flights.states[:2, flight].T, flights.states[3:5, flight].T
        for i in range(drones):
            others = np.arange(drones) != i
            u = law.acceleration(v[i], x[others] - x[i], v[others], [0.3, -0.2])
            ours = flights.sums[:, flight, i] + following * np.array([0.3, -0.2])
            np.testing.assert_allclose(ours, u, rtol=1e-10, atol=1e-10)


def test_two_drones_at_one_spot_are_pushed_as_the_law_pushes_them() -> None:
    for parameters in (FlockingParameters(weight=UNIFORM), FlockingParameters()):
        scenario = flock(drones=2)
        drone = scenario.drone.model_copy(update={"flocking": parameters})
        flights = FlockFlights([scenario.model_copy(update={"drone": drone})])
        flights.states[:] = 0.0
        flights.perceive(0)
        u = FlockingLaw(parameters).acceleration([0.0, 0.0], [[0.0, 0.0]], [[0.0, 0.0]], [0.0, 0.0])
        np.testing.assert_allclose(flights.sums[:, 0], np.column_stack([u, u]))


@pytest.mark.parametrize(
    ("scenario", "drones"),
    [
        (flock(duration_s=20.0, drone__flocking__weight__kind="uniform"), 5),
        (flock(duration_s=15.0, vehicle__gust_m_s=0.2, seed=3), 3),
        (flock(duration_s=10.0, drone__flocking__weight__nearest=3), 12),
        (flock(duration_s=15.0, drone__mission__height_m=9.0), 2),
    ],
)
def test_a_flight_is_the_simulators_flight_with_exact_states(scenario: ScenarioConfig, drones: int) -> None:
    scenario = with_drones(scenario, drones)
    positions, velocities = _flown(FlockFlights([scenario]))
    _, true_positions, true_velocities = fly_exact_states(scenario, gated=False)
    np.testing.assert_allclose(positions[:, 0], true_positions, atol=1e-9)
    np.testing.assert_allclose(velocities[:, 0], true_velocities, atol=1e-9)


def test_the_figures_are_those_of_the_metrics() -> None:
    scenario = flock(drones=9, duration_s=15.0)
    flights = FlockFlights([_seeded(scenario, seed) for seed in (4, 5)])
    positions, velocities = _flown(flights)
    for flight, figures in enumerate(flights.figures()):
        x, v = positions[:, flight], velocities[:, flight]
        pairs = np.triu_indices(9, 1)
        nearest = closest_distances(x)[:, *pairs].min(axis=1)
        assert figures["min_distance_m"] == pytest.approx(nearest.min(), abs=1e-12)
        assert figures["min_distance_after_10s_m"] == pytest.approx(nearest[20:].min(), abs=1e-12)
        assert figures["min_distance_tail_m"] == pytest.approx(nearest[10:].min(), abs=1e-12)
        assert figures["min_level_distance_m"] == pytest.approx(
            closest_distances(x[..., :2])[:, *pairs].min(), abs=1e-12
        )
        assert figures["order_tail"] == pytest.approx(np.mean([order(step[:, :2]) for step in v[10:]]), abs=1e-12)
        assert figures["union_tail"] == pytest.approx(np.mean([union(step[:, :2], 20.0) for step in x[10:]]))
        assert figures["safety"] == pytest.approx(np.mean([safety(step) for step in x]))


def test_a_flock_that_has_fallen_apart_is_told_by_its_union() -> None:
    scenario = flock(drones=4, duration_s=1.0)
    flights = FlockFlights([scenario])
    flights.states[0, 0] = [0.0, 15.0, 300.0, 310.0]
    flights.states[1, 0] = 0.0
    _flown(flights)
    assert flights.figures()[0]["union_tail"] == pytest.approx(2 / 3)


def test_contacts_are_counted_from_touch_to_free() -> None:
    scenario = flock(drones=2, duration_s=4.0, drone__flocking__max_acceleration_m_s2=0.001)
    flights = FlockFlights([scenario])
    flights.states[:, 0] = np.array([[0.0, 0.0, -4.0, 1.0, 0.0, 0.0], [3.0, 0.0, -4.0, -1.0, 0.0, 0.0]]).T
    figures = _and_fly(flights)  # 3 m apart, at 2 m/s towards each other: within 0.7 m from 1.15 to 1.85 s
    assert figures["drone_collisions"] == 2  # each of the two drones has one
    assert figures["min_distance_m"] == pytest.approx(0.0, abs=0.01)


def test_drones_that_pass_between_two_steps_are_as_near_as_they_were() -> None:
    """At 2 m/s each, 0.34 m aside. A step before they meet one is ahead of the other by a, with a^2 + 0.34^2 = 0.996^2:
    then at the steps they are 0.996 m and farther apart."""
    ahead_m = math.sqrt(0.996**2 - 0.34**2) + 2 * 2.0  # two steps of 2 m before that
    free = {"drone__flocking__max_acceleration_m_s2": 1e-6, "drone__flocking__max_speed_m_s": 2.0}
    flights = FlockFlights([flock(drones=2, duration_s=4.0, **free)])
    flights.states[:, 0] = np.array([[0.0, 0.0, -4.0, 2.0, 0.0, 0.0], [ahead_m, 0.34, -4.0, -2.0, 0.0, 0.0]]).T
    positions, _ = _flown(flights)
    at_steps = np.linalg.norm(positions[:, 0, 0] - positions[:, 0, 1], axis=1).min()
    assert at_steps == pytest.approx(0.996, abs=1e-4)
    figures = flights.figures()[0]
    for name in ("min_distance_m", "min_distance_tail_m", "min_level_distance_m"):
        assert figures[name] == pytest.approx(0.34, abs=1e-4)
    assert figures["min_distance_after_10s_m"] is None
    assert figures["drone_collisions"] == 2
    assert figures["safety"] == pytest.approx(1 - 1 / 8)  # nearer than 1 m at one step of eight


@pytest.mark.parametrize(("fast", "speed_m_s"), [(64, 0.3), (64, 4.0), (2, 20.0)])
def test_of_many_that_cross_the_nearest_are_found(fast: int, speed_m_s: float) -> None:
    """All pairs of 64 drones that fly every which way while their flock moves on, beside what cells find.

    Two that are fast have passed drones that are many cells away by the next step.
    """
    flights = FlockFlights([flock(drones=64, duration_s=1.0)] * 4)
    random = np.random.default_rng(1)
    lattice = 2.5 * np.stack(np.divmod(np.arange(64.0), 8.0))
    flights.states[:2] = lattice[:, None] + random.uniform(-0.3, 0.3, (2, 4, 64))
    flights.states[2] = random.normal(0.0, 0.2, (4, 64))
    flights.states[3:5] = np.array([5.0, -3.0])[:, None, None]
    flights.states[3:5, :, :fast] += random.normal(0.0, speed_m_s, (2, 4, fast))
    positions, _ = _flown(flights)
    share = np.linspace(0.0, 1.0, 2001)[:, None, None]
    for flight, figures in enumerate(flights.figures()):
        begin, end = positions[:, flight]
        ways = begin + share * (end - begin)
        one, other = np.triu_indices(64, 1)
        offsets = ways[:, one] - ways[:, other]
        apart = [np.sqrt((offsets[..., :k] ** 2).sum(axis=-1).min()) for k in (2, 3)]
        fine_m = 4 * speed_m_s * 0.5 / 2000  # how much a distance changes from one sample to the next
        found = figures["min_level_distance_m"], figures["min_distance_m"]
        assert found == pytest.approx(apart, abs=2 * fine_m)


def _and_fly(flights: FlockFlights) -> dict[str, Any]:
    _flown(flights)
    return dict(flights.figures()[0])


def test_order_of_one_that_stands_still_counts_as_in_the_metrics() -> None:
    velocity = np.array([[[1.0, 0.0, 2.0]], [[0.0, 0.0, 1.0]]])
    assert orders(velocity)[0] == pytest.approx(order(velocity[:, 0].T))


@pytest.mark.parametrize("weight", ["uniform", "nearest"])
def test_a_flight_is_the_same_in_any_batch(weight: str) -> None:
    scenario = flock(drones=300, duration_s=5.0, drone__flocking__weight__kind=weight)
    flown = [_seeded(scenario, seed) for seed in (7, 8, 3)]
    alone = [fly_flocks([one])[0] for one in flown[:2]]
    shorter = scenario.model_copy(update={"duration_s": 1.0})
    assert fly_flocks([flown[2], flown[1], shorter, flown[0]])[1::2] == alone[::-1]
    assert alone[0] != alone[1]  # the seed moves the starts


@pytest.mark.parametrize(
    ("name", "why"),
    [("led_by_hand", r"vehicles\[0\] is flown by hand"), ("forest", "obstacles"), ("one_knows", "places")],
)
def test_what_takes_more_than_the_law_is_refused(name: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        fly_flocks([flock(name)])


def test_at_10_hz_a_flock_with_measured_errors_keeps_the_order_that_it_has_at_2_hz() -> None:
    """What the own velocity is wrong by for seconds is not to be added to it ten times a second."""
    flown = {
        step_s: fly_flocks(
            [flock().model_copy(update={"seed": seed, "drone": drone}) for seed in range(4)], errors=SHIPPED
        )
        for step_s in (0.5, 0.1)
        for drone in [flock().drone.model_copy(update={"step_s": step_s})]
    }
    disorder = {step_s: 1 - np.mean([figures["order_tail"] for figures in each]) for step_s, each in flown.items()}
    assert disorder[0.5] < 0.001, "as flown in the paper"
    assert disorder[0.1] < 2 * disorder[0.5]
    nearest = {step_s: float(np.min([figures["min_distance_m"] for figures in each])) for step_s, each in flown.items()}
    assert nearest[0.1] > nearest[0.5] - 0.05
