"""A pilot flies by hand before a wall that flockd tells of: the fake autopilot and PX4 do the same."""

from __future__ import annotations

import os

import pytest

from tools.checks.autopilot_contract import seen
from tools.checks.by_hand import ASKS, BY_HAND

PX4 = pytest.mark.skipif("FLOCKD_PX4" not in os.environ, reason="FLOCKD_PX4 names no SITL build folder of PX4")
STEPS = (
    ("arm", "accepted"),
    ("take off", "accepted"),
    ("take off", "in the air"),
    ("text", "it is whole"),
    ("blind", "the drone does not move"),
    ("blind", "the mode is hold"),
    ("wall", "3 m flown"),
    ("wall", "it stands, the stick still forward"),
    ("wall", "CP_DIST before the wall"),
    ("unknown", "the drone does not move"),
    ("unknown", "the mode is still position"),
    ("old", "the drone does not move"),
    ("old", "the mode is hold"),
    ("land", "accepted"),
    ("land", "the mode is land"),
    ("land", "disarmed on the ground, in mode hold"),
)


@pytest.mark.parametrize(("autopilot", "speed_factor"), [("fake", 3.0), pytest.param("px4", 1.0, marks=PX4)])
def test_a_pilot_is_stopped_before_the_wall_and_where_nothing_is_known(autopilot: str, speed_factor: float) -> None:
    rows = seen(autopilot, BY_HAND, speed_factor)
    assert [(row.story, row.what) for row in rows] == list(STEPS)
    assert {row.story for row in rows} == {"arm", "take off", *ASKS}
