"""PX4's flight-test card MC_11, step by step, with offboard in the place of its external mode."""

from __future__ import annotations

import os

import pytest

from tools.checks.autopilot_contract import seen
from tools.checks.mc_11 import ASKS, MC_11

PX4 = pytest.mark.skipif("FLOCKD_PX4" not in os.environ, reason="FLOCKD_PX4 names no SITL build folder of PX4")
PATTERN = tuple(
    f"{corner}: {seen}"
    for corner in ("north", "east", "back")
    for seen in ("the corner by the autopilot's estimate", "and in truth")
)
STEPS = (
    ("registration", "offboard can be selected"),
    ("registration", "flockd silent: it cannot"),
    ("registration", "flockd streams again: it can"),
    ("arm", "accepted"),
    ("take off", "accepted"),
    ("take off", "in the air"),
    ("engage", "the mode is offboard at the first request"),
    ("engage", "no refusal is said"),
    *(("pattern", what) for what in (*PATTERN, "the height is kept")),
    ("disengage", "the mode is hold"),
    ("disengage", "flockd is silent, and the mode stays"),
    ("takeover by sticks", "the mode is position"),
    ("takeover by sticks", "flockd is silent, and the mode stays"),
    ("takeover by sticks", "2 m flown by hand"),
    ("takeover by sticks", "setpoints meanwhile: 0"),
    ("re-engage elsewhere", "the mode is offboard at the first request"),
    ("re-engage elsewhere", "no refusal is said"),
    *(("the same pattern", what) for what in (*PATTERN, "the height is kept")),
    ("node killed", "2 m flown by the process"),
    ("node killed", "the mode is hold"),
    ("node killed", "a ground station is told: Failsafe activated"),
    ("link lost", "the mode is hold"),
    ("link lost", "flockd has noticed, and ends its stream"),
    ("link lost", "the link is back"),
    ("link lost", "flockd is silent, and the mode stays"),
    ("land", "accepted"),
    ("land", "the mode is land"),
    ("land", "disarmed on the ground, in mode hold"),
)
"""What the card asks for, and what a pilot needs beside it, in this order."""


@pytest.mark.parametrize(("autopilot", "speed_factor"), [("fake", 2.0), pytest.param("px4", 1.0, marks=PX4)])
def test_every_step_of_px4s_card_goes_as_it_asks(autopilot: str, speed_factor: float) -> None:
    rows = seen(autopilot, MC_11, speed_factor)
    assert [(row.story, row.what) for row in rows] == list(STEPS)


def test_every_step_says_what_the_card_asks_for() -> None:
    assert {story for story, _ in STEPS} == ASKS.keys()
