"""Drones that meet, in the closed loop: made-up detections with errors, tracker, law, gate at 20 Hz, vehicles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flockd.campaign.flight_plan import CASE, Cell, Plan
from flockd.core.config.mission import MissionParameters
from flockd.review.metrics import closest_distances
from flockd.sim.flock.exact_states import fly_exact_states
from flockd.sim.scenario import DetectionsConfig, ScenarioConfig, StartConfig, load_scenario
from tests.make import changed

pytestmark = pytest.mark.fault("head-on")

CONFIG = Path(__file__).parents[3] / "config"
ENCOUNTER = load_scenario(CONFIG / "encounter.yaml")
MISSED = 0.08
"""At all distances, for flights above the safe speed: there misses as measured, most beyond 7 m, judge the networks and
not law, tracker and gate. Some drones touch then, which config/campaigns/encounters.yaml counts."""
RECIPROCAL = Plan.load(CONFIG / "campaigns/reciprocal.yaml")


def nearest_m(scenario: ScenarioConfig) -> float:
    """How near any two come, between steps too."""
    distances = closest_distances(fly_exact_states(scenario)[1])
    return float(distances[:, ~(distances[0] == 0.0)].min())


def head_on(speed_m_s: float, seed: int, **detections: Any) -> ScenarioConfig:
    """Two that begin 30 m apart."""
    side_m = 0.025 * (seed % 5 - 2)
    vehicles = tuple(
        StartConfig(
            position_m=(-15.0 * way, way * side_m, -5.0),
            velocity_m_s=(way * speed_m_s, 0.0),
            mission=MissionParameters(kind="velocity", velocity_m_s=(way * speed_m_s, 0.0)),
        )
        for way in (1.0, -1.0)
    )
    assert ENCOUNTER.detections is not None
    changes = {
        "vehicles": vehicles,
        "seed": seed,
        "duration_s": 15.0 / speed_m_s + 8.0,
        "detections": ENCOUNTER.detections.model_copy(update=detections),
    }
    return ENCOUNTER.model_copy(update=changes)


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 12), marks=pytest.mark.slow)], ids=["few", "many"])
@pytest.mark.parametrize("speed_m_s", [1.5, 2.0, 3.0])
def test_drones_that_meet_head_on_stay_apart(speed_m_s: float, seeds: range) -> None:
    """At least 1 m apart at every instant, with ranges that err as by sight and a step every half second."""
    seen = {"missed": MISSED} if speed_m_s > 1.5 else {}
    assert min(nearest_m(head_on(speed_m_s, seed, **seen)) for seed in seeds) >= 1.0


@pytest.mark.parametrize(("range_error", "missed", "least_m"), [(0.2, 0.05, 1.0), (0.05, 0.3, 1.0), (0.2, 0.3, 0.7)])
def test_ranges_that_err_much_and_many_misses_bring_nobody_together(
    range_error: float, missed: float, least_m: float
) -> None:
    """Faster than real drones may. With both, of which networks are far, drones do not touch."""
    apart_m = [nearest_m(head_on(2.0, seed, range_error=range_error, missed=missed)) for seed in range(3)]
    assert min(apart_m) >= least_m


@pytest.mark.fault("one-that-does-not-avoid")
@pytest.mark.parametrize("cell", RECIPROCAL.cells[:11], ids=lambda cell: cell.parameters[CASE])
def test_reciprocal_encounters(cell: Cell) -> None:
    """One flight of each way that two can meet, and some of five; `config/campaigns/reciprocal.yaml` has the others."""
    flight = RECIPROCAL.task(cell, 0).scenario()
    alone = cell.parameters[CASE] == "two_one_without_flockd"
    assert nearest_m(changed(flight, detections__missed=MISSED) if alone else flight) >= 1.0


@pytest.mark.parametrize("number", [140, 87, 91])
def test_among_mates_a_drone_steps_out_of_the_way_of_one_that_a_person_flies(number: int) -> None:
    """Three flights in which it came within 0.34, 0.70 and 0.75 m: it changed sides, or chose a closed one. With the
    errors with which they were found, fewer than those of flights by sight, with which one in some touches."""
    (cell,) = [cell for cell in RECIPROCAL.cells if cell.parameters[CASE] == "five_one_without_flockd"]
    errors = DetectionsConfig(
        missed=0.05, range_error=0.05, bearing_error_rad=0.005, error_time_s=1.85, missed_time_s=3.04,
        false_at_once=0.004, false_time_s=0.7, false_m=(3.7, 5.4, 9.2),
    )  # fmt: skip
    assert nearest_m(RECIPROCAL.task(cell, number).scenario().model_copy(update={"detections": errors})) >= 1.0


@pytest.mark.fault("one-that-does-not-avoid")
@pytest.mark.parametrize("speed_m_s", [1.0, 2.0])
@pytest.mark.parametrize("trapped", ["between two", "beside the fence", "near the fence"])
def test_where_the_usual_side_is_taken_a_drone_leaves_to_the_other(trapped: str, speed_m_s: float) -> None:
    """People fly at one that hovers, from both sides, or along a fence that is 0.8 m to its right. Or at one that flies
    1.4 m from the fence, where it has room for a second."""

    def comes(way: float, *, by_hand: bool = True) -> StartConfig:
        velocity = (-way * speed_m_s, 0.0)
        mission = MissionParameters(kind="velocity", velocity_m_s=velocity)
        place = (12.0 * way, 0.05, -5.0) if by_hand else (0.0, 0.0, -5.0)
        return StartConfig(position_m=place, velocity_m_s=velocity, mission=mission, by_hand=by_hand)

    hovers = StartConfig(position_m=(0.0, 0.0, -5.0), mission=MissionParameters(kind="hover"))
    own = comes(-1.0, by_hand=False) if trapped == "near the fence" else hovers
    others = [comes(1.0), comes(-1.0)] if trapped == "between two" else [comes(1.0)]
    side_m = 1.4 if trapped == "near the fence" else 0.8
    corners = ((-60.0, -60.0), (-60.0, side_m), (60.0, side_m), (60.0, -60.0))
    fence = {} if trapped == "between two" else {"drone__safety__gate__fence_corners_m": corners}
    flight = changed(ENCOUNTER, vehicles=(own, *others), duration_s=12.0 / speed_m_s + 4.0, **fence)
    places = fly_exact_states(changed(flight, detections__missed=0.05))[1]
    assert closest_distances(places)[:, 0, 1:].min() >= (1.0 if trapped == "near the fence" else 0.8)
