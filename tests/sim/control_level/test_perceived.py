"""Errors of perception at control level: none gives the exact law, and drawn ones are as large and long as asked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.data import data_path
from flockd.core.errors import ConfigError
from flockd.core.messages import FloatArray
from flockd.sim.control_level import fly_flocks
from flockd.sim.control_level.flock_flights import FlockFlights
from flockd.sim.flock.start import scattered
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.scenario.perceived import load_perceived_errors
from tests.sim.control_level.flocks import FAULTLESS, SHIPPED, errors, flock, level


def _pair(distance_m: float, flights: int, law: dict[str, Any] | None = None) -> list[ScenarioConfig]:
    """Two drones at one height, north of each other and at a standstill, that feel cohesion only."""
    keys = {f"drone__flocking__{key}": value for key, value in {"alignment": 0.0, **(law or {})}.items()}
    scenario = flock(drones=2, **keys)
    starts = [
        vehicle.model_copy(update={"position_m": (north, 0.0, -4.0), "velocity_m_s": (0.0, 0.0)})
        for vehicle, north in zip(scenario.vehicles, (0.0, distance_m), strict=True)
    ]
    return [scenario.model_copy(update={"seed": seed, "vehicles": tuple(starts)}) for seed in range(flights)]


def _seen(flights: FlockFlights, step: int) -> FloatArray:
    """(2, flights): cohesion of the first drone."""
    flights.perceive(step)
    return flights.sums[:, :, 0].copy()


@pytest.mark.parametrize("weight", ["uniform", "nearest"])
def test_without_errors_a_drone_flies_as_by_exact_states(weight: str) -> None:
    scenario = flock(drones=30, drone__flocking__weight__kind=weight, duration_s=5.0)
    one_height = scattered(level(scenario), 0.5)
    exact, seen = FlockFlights([one_height]), FlockFlights([one_height], errors())
    for flights in (exact, seen):
        flights.perceive(0)
    np.testing.assert_allclose(seen.sums, exact.sums, atol=1e-12)


def test_errors_are_as_large_as_measured() -> None:
    distance_m, desired_m = 7.0, 3.5
    wrong = errors({"range_error": {"median": 0.02, "p95": 0.08}, "bearing_error_deg": {"median": 0.5, "p95": 2.0}})
    pull = _seen(FlockFlights(_pair(distance_m, 4000), wrong), 3)
    size, bearing = np.hypot(*pull), np.degrees(np.arctan2(pull[1], pull[0]))
    ranges = np.linspace(5.0, 10.0, 20001)  # the pull grows with the range: 0.1 d ln(d / 3.5)
    log_error = np.log(np.interp(size, 0.1 * ranges * np.log(ranges / desired_m), ranges) / distance_m)
    assert np.median(np.abs(log_error)) == pytest.approx(0.02, rel=0.08)
    assert np.percentile(np.abs(log_error), 95) == pytest.approx(0.08, rel=0.08)
    assert np.median(np.abs(bearing)) == pytest.approx(0.5, rel=0.08)
    assert np.percentile(np.abs(bearing), 95) == pytest.approx(2.0, rel=0.08)
    assert abs(np.median(log_error)) < 0.003


def test_a_share_is_missed_for_about_the_time_that_was_measured() -> None:
    flights = FlockFlights(_pair(7.0, 800), errors({"missed": 0.2}, missed_time_s=4.0))
    missed = np.array([_seen(flights, step)[0] == 0.0 for step in range(24)])
    assert missed.mean() == pytest.approx(0.2, abs=0.03)
    again = missed[1:][missed[:-1]].mean()  # half a second after a step in which it was missed
    assert 0.6 < again < 0.95
    assert missed[16:][missed[:8]].mean() < 0.35  # eight seconds after


def test_a_neighbour_behind_another_is_hidden() -> None:
    scenario = _pair(4.0, 1)[0]
    behind = scenario.vehicles[1].model_copy(update={"position_m": (9.0, 0.05, -4.0)})
    three = scenario.model_copy(update={"vehicles": (*scenario.vehicles, behind)})
    one = _seen(FlockFlights([scenario], errors(hidden_limit=0.5)), 0)
    np.testing.assert_array_equal(_seen(FlockFlights([three], errors(hidden_limit=0.5)), 0), one)
    assert _seen(FlockFlights([three], errors()), 0)[0, 0] > one[0, 0] + 0.5  # 0.1 * 9 * ln(9 / 3.5) = 0.85 more


def test_nobody_is_seen_beyond_the_range_or_too_far_above() -> None:
    assert _seen(FlockFlights(_pair(7.0, 1), errors(range_limit_m=6.9)), 0)[0, 0] == 0.0
    above = _pair(1.0, 1)[0]
    above = above.model_copy(
        update={"vehicles": (above.vehicles[0], above.vehicles[1].model_copy(update={"position_m": (1.0, 0.0, -6.0)}))}
    )
    assert _seen(FlockFlights([above], errors(elevation_limit_deg=45.0)), 0)[0, 0] == 0.0
    assert _seen(FlockFlights([above], errors(elevation_limit_deg=70.0)), 0)[0, 0] != 0.0


def test_what_is_seen_for_a_moment_hardly_draws_the_flock_apart() -> None:
    """The worst of 60 flights with the errors of the shipped networks, beside the same with the whole pull at once."""
    base = flock()
    worst = {}
    for time_s in (5.0, None):
        flocking = base.drone.flocking.model_copy(update={"cohesion_time_s": time_s})
        scenario = base.model_copy(update={"drone": base.drone.model_copy(update={"flocking": flocking})})
        flights = [scenario.model_copy(update={"seed": seed}) for seed in range(60)]
        worst[time_s] = min(float(one["order_tail"] or 0.0) for one in fly_flocks(flights, errors=SHIPPED))
    assert worst[5.0] > 0.998 > worst[None]


def test_a_false_neighbour_pulls_by_its_age() -> None:
    """0.1 * 9 * ln(9 / 3.5) = 0.85 m/s^2 by Eq. 39, at most 2 (2 / 5)^2 in the 2 s that it lasts."""
    false = {"at_once": 0.4, "lifetime_s": 2.0, "distances_m": [8.9, 9.0, 9.1]}

    def pulls(time_s: float | None) -> FloatArray:
        flights = FlockFlights(
            _pair(40.0, 500, {"cohesion_time_s": time_s}), errors(range_limit_m=30.0, false_neighbours=false)
        )
        sums = np.hypot(*np.array([_seen(flights, step) for step in range(6)]).transpose(1, 0, 2))
        some: FloatArray = sums[sums > 1e-9]
        return some

    assert np.median(pulls(None)) == pytest.approx(0.85, abs=0.01)
    assert 0.05 < np.median(pulls(5.0)) < 0.15
    assert np.percentile(pulls(5.0), 95) < 0.4


def test_false_neighbours_are_as_many_as_measured() -> None:
    wrong = errors(range_limit_m=30.0, false_neighbours={**FAULTLESS["false_neighbours"], "at_once": 0.4})
    flights = FlockFlights(_pair(40.0, 2000), wrong)
    pulled = [np.any(_seen(flights, step) != 0.0, axis=0).mean() for step in (0, 40)]
    assert np.mean(pulled) == pytest.approx(1 - 0.9**4, abs=0.04)  # none of four that are there one time in ten


def test_its_own_velocity_errs_too() -> None:
    wrong = errors(own_velocity_error_m_s={"median": 0.05, "p95": 0.2}, range_limit_m=1.0)
    own = _seen(FlockFlights(_pair(40.0, 2000), wrong), 0)  # -V of Eq. 38, nothing else
    assert np.median(np.abs(own)) == pytest.approx(0.05, rel=0.08)
    assert np.percentile(np.abs(own), 95) == pytest.approx(0.2, rel=0.08)


def test_a_flight_with_errors_is_the_same_in_any_batch() -> None:
    wrong = errors({"missed": 0.1, "range_error": {"median": 0.02, "p95": 0.08}}, hidden_limit=0.5)
    scenario = flock(drones=40, duration_s=4.0)
    seeds = [scattered(scenario.model_copy(update={"seed": seed}), 0.5) for seed in range(3)]
    alone = fly_flocks(seeds[1:2], errors=wrong)
    assert fly_flocks(seeds, errors=wrong)[1:2] == alone
    assert fly_flocks(seeds[1:2]) != alone


def test_a_file_that_cannot_be_is_refused_with_its_place(tmp_path: Path) -> None:
    file = tmp_path / "errors.yaml"
    text = (data_path("config") / "perceived" / "shipped_networks.yaml").read_text(encoding="utf-8")
    file.write_text(text.replace("hidden_limit: 0.5", "hidden_limit: 1.5"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"errors\.yaml.*hidden_limit"):
        load_perceived_errors(file)
