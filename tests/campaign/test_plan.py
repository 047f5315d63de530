"""A person writes a campaign, makes a slip, and is told where it is; what is right becomes cells and seeds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flockd.campaign.flight_kinds import FlownRun
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.folder import flight_rows
from flockd.core.data import data_path
from flockd.core.errors import ConfigError
from tests.campaign.flights import HEAD, PAPER, campaign_file

EXAMPLES = sorted((data_path("config") / "campaigns").glob("*.yaml"))


def problems(folder: Path, text: str, head: str = HEAD) -> list[str]:
    path = campaign_file(folder, text, head)
    with pytest.raises(ConfigError) as caught:
        Plan.load(path)
    return [str(problem).replace(str(path), "FILE") for problem in caught.value.problems]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_can_be_flown(path: Path) -> None:
    plan = Plan.load(path)
    assert plan.config.campaign == path.stem


@pytest.mark.parametrize("name", ["encounters", "reciprocal", "reciprocal_25", "head_on_by_sight"])
def test_drones_that_are_to_avoid_each_other_begin_far_apart(name: str) -> None:
    """Else a flight shows where drones were put, not what they do: two groups once began a metre apart."""
    plan = Plan.load(next(path for path in EXAMPLES if path.stem == name))
    for cell in plan.cells:
        starts = np.array([one.position_m for one in plan.task(cell, 0).scenario().vehicles])
        apart_m = np.linalg.norm(starts[:, None] - starts, axis=-1)[np.triu_indices(len(starts), 1)]
        assert apart_m.min() >= 2.0, cell.parameters


def test_a_grid_is_all_combinations_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = """\
vary:
  drone.flocking.cohesion: {values: [0.1, 0.2, 0.3]}
  drones: {values: [2, 7]}
cases:
  calm: {}
  windy: {vehicle.gust_m_s: 0.4}
"""
    plan = Plan.load(campaign_file(tmp_path, text))
    assert [tuple(cell.parameters.values()) for cell in plan.cells] == [
        (case, cohesion, drones) for case in ("calm", "windy") for cohesion in (0.1, 0.2, 0.3) for drones in (2, 7)
    ]
    last = plan.task(plan.cells[-1], 4).scenario()
    assert (last.drone.flocking.cohesion, len(last.vehicles), last.vehicle.gust_m_s) == (0.3, 7, 0.4)
    assert last.seed == 4
    first = plan.task(plan.cells[0], 0).scenario()
    assert (first.vehicle.gust_m_s, first.drone.flocking.separation) == (0.0, 10.0)


def test_a_flight_moves_its_starts_by_its_seed_alone(tmp_path: Path) -> None:
    plan = Plan.load(campaign_file(tmp_path, ""))
    starts = [plan.task(plan.cells[0], number).scenario().vehicles[1].position_m for number in range(6)]
    assert len(set(starts)) == 6
    assert all(abs(north - 0.5) <= 0.5 and abs(east + 2.8) <= 0.5 and down == -4.0 for north, east, down in starts)
    later = Plan.load(campaign_file(tmp_path, "seed: 2\n"))
    assert later.task(later.cells[0], 0).scenario() == plan.task(plan.cells[0], 2).scenario()


def test_cells_that_are_not_paired_have_seeds_of_their_own(tmp_path: Path) -> None:
    """Cell c begins at `seed` + c `seeds`: two cells of six flights, from 7 on."""
    path = campaign_file(tmp_path, "seed: 7\npaired: false\nvary: {drones: {values: [2, 3]}}\n")
    plan = Plan.load(path)
    tasks = [plan.task(cell, number) for cell in plan.cells for number in range(plan.config.seeds)]
    assert [task.scenario().seed for task in tasks] == list(range(7, 19))
    rows = flight_rows(plan, [FlownRun(task.run) for task in tasks])
    assert [row["seed"] for row in rows] == list(range(7, 19))


def test_a_plan_is_its_own_copy(tmp_path: Path) -> None:
    """What is rerun months later needs no file but the folder's."""
    text = (
        "perception: sight\nfixed: {vehicle.wind_m_s: [1, 2]}\ncases: {new: {}, before: {drones: 3}}\n"
        "vary: {drone.flocking.separation: {values: [9.0]}, drone.flocking.cohesion: {values: [0.1, 0.2]}}\n"
    )
    plan = Plan.load(campaign_file(tmp_path, text))
    again = Plan.from_values(json.loads(plan.to_json()))
    assert again.to_json() == plan.to_json()
    assert again.cells == plan.cells  # neither cases nor keys are in the order of the alphabet
    assert again.task(again.cells[1], 5).scenario() == plan.task(plan.cells[1], 5).scenario()
    assert Run(1, 5).name == "c1-s5"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "vary:\n  drone.flocking.cohesoin: {values: [1]}\n",
            "6: vary.drone.flocking.cohesoin.values[0]: is not a",
        ),
        (
            "vary:\n  drone.flocking.cohesion:\n    values:\n      - 0.1\n      - -1\n",
            "9: vary.drone.flocking.cohesion.values[1]: -1 is not at least 0",
        ),
        ("fixed:\n  vehicles.0: 4\n", "6: fixed.vehicles.0: `vehicles` is not a section"),
        ("measure: [collisions, collisions]\n", "5: measure[1]: collisions is named already; delete one"),
        (
            "cases: {a: {vehicle: {gust_m_s: 0.3}, vehicle.gust_m_s: 0.1}}\n",
            "5: cases.a.vehicle.gust_m_s: is a part of vehicle, which stands here too; write it there",
        ),
        ("cases: {a: {drones: 4}, b: {drones: 4}}\n", "5: cases.b: has the values of a; change them, or delete one"),
        ("fixed: {drones: 5.5}\n", "5: fixed.drones: must be whole numbers from 1 to 100"),
        (
            "vary:\n  duration_s: {values: [5.0, 6.0, 5.0]}\n",
            "6: vary.duration_s.values[2]: 5.0 is given already; delete one",
        ),
        ("measure: [min_distance]\n", "5: measure[0]: min_distance is not known; did you mean `min_distance_m`?"),
        ("fixed: {seed: 3}\n", "5: fixed.seed: is set for each flight"),
        ("perception: control\n", "5: perception: "),
    ],
)
def test_a_slip_is_told_with_its_line_and_key(text: str, expected: str, tmp_path: Path) -> None:
    assert any(problem.startswith(f"FILE:{expected}") for problem in problems(tmp_path, text)), problems(tmp_path, text)


def test_seeds_that_change_nothing_are_refused(tmp_path: Path) -> None:
    head = f"campaign: test\nscenario: {PAPER}\nseeds: 6\n"
    (problem,) = problems(tmp_path, "", head)
    assert problem.startswith("FILE:3: seeds: are all the same flight")
    Plan.load(campaign_file(tmp_path, "fixed: {vehicle.gust_m_s: 0.2}\n", head))


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("fixed: {vehicle.wind_m_s: [4, -2]}\n", "FILE:6: fixed.vehicle.wind_m_s: "),
        ("cases:\n  calm: {}\n  wind: {vehicle.wind_m_s: [4, -2]}\n", "FILE:8: cases.wind.vehicle.wind_m_s: "),
        ("vary:\n  vehicle.wind_m_s: {values: [[0, 0], [3, 0]]}\n", "FILE:7: vary.vehicle.wind_m_s: "),
    ],
)
def test_a_wind_that_no_flight_would_notice_is_refused(text: str, line: str, tmp_path: Path) -> None:
    """It tilts the drone and its cameras, and without images nothing follows from that."""
    (problem,) = problems(tmp_path, f"perception: truth\n{text}")
    assert problem.startswith(f"{line}changes nothing without images")
    assert "vehicle.gust_m_s" in problem
    Plan.load(campaign_file(tmp_path, f"perception: sight\n{text}"))


def test_a_drones_file_is_no_scenario(tmp_path: Path) -> None:
    head = f"campaign: test\nscenario: {PAPER.with_name('simulator.yaml')}\nseeds: 6\n"
    (problem,) = problems(tmp_path, "", head)
    assert problem.startswith("FILE:2: scenario: names ")
