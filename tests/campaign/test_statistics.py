"""Intervals, the stop rule and the comparison, with numbers from outside the code."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from flockd.campaign.conduct import Schedule
from flockd.campaign.figures import mean_interval
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.verdicts import paired_p
from tests.campaign.flights import HEAD, campaign_file


def test_a_mean_has_students_interval() -> None:
    """t(4 degrees of freedom, 97.5 %) is 2.776; of 1 to 5 the standard deviation is 1.5811."""
    interval = mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert interval is not None
    assert interval.mean == 3.0
    assert interval.half_width == pytest.approx(2.776 * 1.5811 / 5**0.5, abs=1e-3)
    assert mean_interval([1.0]) is None
    assert mean_interval([]) is None


def test_a_share_has_wilsons_interval() -> None:
    """Newcombe, "Two-sided confidence intervals for the single proportion" (1998), table I, without continuity
    correction: 81 of 263 is 0.2553 to 0.3662, 0 of 20 is 0 to 0.1611."""
    of_many = mean_interval([1.0] * 81 + [0.0] * 182, is_share=True)
    assert of_many is not None
    assert of_many[1:] == pytest.approx((0.2553, 0.3662), abs=1e-4)
    none = mean_interval([0.0] * 20, is_share=True)
    assert none is not None
    assert none[1:] == pytest.approx((0.0, 0.1611), abs=1e-4)


def stopping(folder: Path) -> Plan:
    text = "vary: {drone.flocking.cohesion: {values: [0.1, 0.2, 0.3]}}\n"
    rule = "stop: {figure: min_distance_m, half_width: 0.5, batch: 4}\n"
    return Plan.load(campaign_file(folder, text + rule, HEAD.replace("seeds: 6", "seeds: 10")))


def value_of(run: Run) -> float | None:
    """In cell 0 nearly always the same, in cell 1 different in the first seeds, in cell 2 seldom any."""
    if run.cell == 0:
        return 0.01 * run.number
    return (3.0 if run.number == 2 else 1.0) if run.cell == 1 else (None if run.number else 1.0)


@pytest.mark.parametrize("order", range(5))
def test_how_many_seeds_a_cell_flies_does_not_depend_on_which_is_done_first(order: int, tmp_path: Path) -> None:
    """The mean of 1, 1, 3, 1 is known to 1.59, of these and four times 1 to 0.59, and of two more to 0.45."""
    schedule, draw = Schedule(stopping(tmp_path)), random.Random(order)
    flying: list[Run] = []
    flown: list[Run] = []
    assert schedule.most_left == 30
    while True:
        while len(flying) < 6 and (runs := schedule.next(2)):
            assert len({run.cell for run in runs}) == 1
            flying += runs
        if not flying:
            break
        run = flying.pop(draw.randrange(len(flying)))
        schedule.finished([(run, value_of(run))])
        flown.append(run)
    assert sorted(flown) == [Run(cell, number) for cell, count in ((0, 4), (1, 10), (2, 10)) for number in range(count)]
    assert schedule.most_left == 0


def test_what_is_done_is_not_flown_again(tmp_path: Path) -> None:
    schedule = Schedule(stopping(tmp_path))
    schedule.finished([(Run(0, number), 0.0) for number in range(4)] + [(Run(1, 1), 2.0)])
    rest = [run for _ in range(20) for run in schedule.next(1)]
    assert rest == [Run(1, 0), Run(1, 2), Run(1, 3), *(Run(2, number) for number in range(4))]


def test_paired_differences_that_all_go_one_way() -> None:
    """Two of 2^5 ways to give signs have a sum as far from zero: p = 1/16."""
    assert paired_p(np.array([0.3, 0.1, 0.2, 0.5, 0.4])) == 2 / 32
    assert paired_p(np.array([1.0, -1.0, 1.0, -1.0])) == 1.0
    assert paired_p(np.full(30, 0.2)) < 1e-3
    assert paired_p(np.tile([1.0, -1.1], 15)) > 0.5
