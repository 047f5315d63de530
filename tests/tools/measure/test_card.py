"""Which flights the card flies, how it goes on, and what it says of them: on figures made up for each flight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from flockd.campaign.flight_plan import Plan
from flockd.campaign.results import Results
from flockd.core.data import data_path
from flockd.sim.scenario import load_scenario
from tools.measure import card
from tools.measure.card import (
    EYES,
    FIGURES,
    REAL_AIRFRAMES,
    SCENARIOS,
    SEEDS,
    Flight,
    Line,
    document,
    encounters,
    flights_of,
    flown,
    read_lines,
    run,
    seeds_of,
    spread,
)
from tools.measure.trouble import TROUBLES, trouble

COMMIT = "0123456789abcdef"


def made_up(flight: Flight) -> Line:
    figures = {"order_tail": flight.seed / SEEDS, "associated_error_p95_m": None if flight.eyes == "blind" else 0.5}
    scenario, eyes, seed = flight.key
    return {"scenario": scenario, "eyes": eyes, "seed": seed, "figures": figures, "wall_s": 1.0, "failed": None}


def test_seeds_follow_from_the_commit_and_are_the_same_for_all_eyes() -> None:
    flights = flights_of(COMMIT, quick=False, airframes=[("x.glb", 0.5)])
    for scenario in SCENARIOS:
        of_eyes = [[one.seed for one in flights if (one.scenario, one.eyes) == (scenario, eyes)] for eyes in EYES]
        assert of_eyes[0] == of_eyes[1] == of_eyes[2]
        assert len(set(of_eyes[0])) == SCENARIOS[scenario].whole[0] >= 10
        assert all(0 <= seed < SEEDS for seed in of_eyes[0])
    assert not set(seeds_of(COMMIT, "forest", 20)) & set(seeds_of("f" * 16, "forest", 20))
    assert len({one.key for one in flights}) == len(flights)


@pytest.mark.parametrize("quick", [True, False])
def test_every_flight_of_the_list_can_be_configured(quick: bool) -> None:
    for flight in flights_of(COMMIT, quick=quick):
        if flight.eyes == "blind":  # whatever it is for the others, and one key
            flight.flown()


def test_a_run_that_was_stopped_goes_on_and_flights_that_failed_are_tried_again(tmp_path: Path) -> None:
    flights, results = flights_of(COMMIT, quick=True), tmp_path / "card" / "a.jsonl"
    tried: list[Flight] = []

    def stops(flight: Flight) -> Line:
        if len(tried) == 3:
            raise KeyboardInterrupt
        tried.append(flight)
        return made_up(flight) | ({"failed": "no world", "figures": {}} if len(tried) == 2 else {})

    with pytest.raises(KeyboardInterrupt):
        run(flights, results, 1, stops)
    with results.open("a", encoding="utf-8") as file:
        file.write('{"scenario": "cut sh')
    assert len(read_lines(results)) == 3

    def notes(flight: Flight) -> Line:
        tried.append(flight)
        return made_up(flight)

    lines = run(flights, results, 1, notes)
    assert [(line["scenario"], line["eyes"], line["seed"]) for line in lines] == [one.key for one in flights]
    assert all(line["failed"] is None for line in lines)
    assert tried[3:] == [flights[1], *flights[3:]]
    assert run(flights, results, 1, notes) == lines
    assert len(tried) == len(flights) + 1, "only the one that failed was flown twice"


def test_median_interval_and_worst_by_hand() -> None:
    """Of twenty values the ranks 6 and 15 hold the median with 95.9 % (Conover 1999, Table A3)."""
    values = [float(k) for k in range(1, 21)]
    of_twenty = spread(values[::-1], higher_is_better=True)
    assert of_twenty == {"median": 10.5, "interval": [6.0, 15.0], "worst": 1.0, "count": 20}
    assert spread([0.00123456, 2.0], higher_is_better=False) == {
        "median": 1.001, "interval": [0.001235, 2.0], "worst": 2.0, "count": 2,
    }  # fmt: skip


def test_the_document_names_commit_networks_and_what_each_scenario_gave() -> None:
    lines = [made_up(one) for one in flights_of(COMMIT, quick=True)]
    lines[0] |= {"failed": "no world", "figures": {}}
    found = document(COMMIT, lines, quick=True)
    json.dumps(found, allow_nan=False)
    assert set(found) == set(SCENARIOS) - {REAL_AIRFRAMES}
    paper = found["the paper's five drones"]
    assert {"commit", "date", "machine", "networks", "command", "flown_s"} <= paper.keys()
    assert all(len(sha256) == 64 for sha256 in paper["networks"].values())
    assert (paper["sight"]["flights"], paper["sight"]["failed"]) == (2, 1)
    assert paper["sight"]["figures"]["order_tail"]["count"] == 1
    assert "associated_error_p95_m" not in paper["blind"]["figures"]


def test_encounters_are_told_by_speed_and_airframe_and_each_flies_with_a_seed_of_its_own() -> None:
    """Six ways to meet and three strengths of gusts in each row; one that meets head-on at 2 m/s touches."""
    plan = Plan.load(data_path("config") / "campaigns/encounters.yaml")
    cells = plan.cells
    assert len({plan.task(cell, n).scenario().seed for cell in cells for n in (0, plan.config.seeds - 1)}) == 2 * 108
    bad = {"case": "head_on_2", "detections.airframe": "unknown", "vehicle.gust_m_s": 0.2}
    rows = [{"cell": one.number, "min_distance_m": 0.69 if one.parameters == bad else 1.234} for one in cells]
    found = encounters(Results(Path(), plan, (*rows, {"cell": 0, "min_distance_m": None}), 0.0))
    assert [tuple(one.values()) for one in found] == [
        (speed, airframe, 18, *((0.69, 1) if (speed, airframe) == (2.0, "unknown") else (1.23, 0)))
        for speed in (1.0, 2.0, 3.0)
        for airframe in ("trained", "unknown")
    ]


@pytest.mark.parametrize("eyes", ["blind", "exact"])
def test_a_flight_is_flown_and_measured(eyes: str) -> None:
    flight = Flight("head-on", eyes, 5, "head_on.yaml", None, EYES[eyes].overrides)
    line = flown(flight)
    assert line["failed"] is None
    assert set(line["figures"]) == set(FIGURES)
    # Two that meet head-on and see each other evade; blind ones meet.
    assert (line["figures"]["min_distance_m"] < 0.5) == (eyes == "blind")


@pytest.mark.parametrize("turn", range(len(TROUBLES)))
def test_what_happens_to_one_of_five_happens_while_they_fly(turn: int) -> None:
    """At every speed, to every drone: the seeds up to 20 have them all."""
    file, duration_s = data_path("config") / "paper_flight.yaml", SCENARIOS["one of five in trouble"].quick[1]
    speeds, drones = set(), set()
    for seed in range(20):
        flown = load_scenario(file, {**trouble(seed, turn), "duration_s": duration_s})
        places = np.array([one.position_m[:2] for one in flown.vehicles])
        apart_m = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)
        np.testing.assert_allclose(apart_m, 2.0, err_msg="a pentagon")
        missions = [one.mission for one in flown.vehicles if not one.by_hand]
        speeds |= {one.velocity_m_s[0] for one in missions if one is not None and one.velocity_m_s is not None}
        happens = [(one.drone, one.time_s) for one in flown.takeovers]
        happens += [(fault.drone, fault.begin_s) for fault in flown.faults[:1]]
        drones |= {drone for drone, _ in happens} | {k + 1 for k, one in enumerate(flown.vehicles) if one.by_hand}
        assert all(5.0 < time_s < flown.duration_s - 3.0 for _, time_s in happens)
    assert speeds == {0.5, 1.0, 1.5, 2.0}
    assert drones == (set() if list(TROUBLES)[turn] == "short steps" else {1, 2, 3, 4, 5})


def test_real_airframes_are_flown_in_turn_where_they_are_given(tmp_path: Path) -> None:
    assert not [one for one in flights_of(COMMIT, quick=True) if one.scenario == REAL_AIRFRAMES]
    bar: Any = trimesh.creation.box((0.6, 0.1, 0.3))
    bar.export(tmp_path / "bar.glb")
    airframes = [(str(tmp_path / "bar.glb"), 0.7), (str(tmp_path / "none.glb"), 0.7)]
    flights = [one for one in flights_of(COMMIT, quick=True, airframes=airframes) if one.scenario == REAL_AIRFRAMES]
    assert [one.airframe for one in flights[:3]] == [airframes[0], airframes[1], airframes[0]]
    assert flights[0].flown().drone.perception.drone_size_m == 0.7
    shapes = flights[0].models()
    assert shapes is not None
    assert len(shapes) == 5
    np.testing.assert_allclose(np.ptp(shapes[4].vertices, axis=0), [0.6, 0.3, 0.1], atol=1e-6)
    assert "none.glb: there is no such file" in str(flown(flights[1])["failed"])


def test_a_story_that_px4_failed_or_did_not_fly_does_not_count_as_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = '<testcase name="test_a_b"/>'
    cases += '<testcase name="test_c[x]"><failure/></testcase><testcase name="d"><skipped/></testcase>'

    def output(*words: str) -> str:
        Path(words[-1].removeprefix("--junitxml=")).write_text(f"<testsuite>{cases}</testsuite>", encoding="utf-8")
        return ""

    monkeypatch.setattr(card, "_output", output)
    assert card._stories() == {"a b": "passed", "c[x]": "failure", "d": "skipped"}
