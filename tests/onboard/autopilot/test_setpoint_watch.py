"""Setpoints of another program are told from flockd's own that the autopilot clips or the link delays."""

from __future__ import annotations

import math

import pytest

from flockd.onboard.autopilot.watches import SetpointWatch

pytestmark = pytest.mark.fault("setpoints-clipped")

TURN_RAD_S = 1.0


def _asked(time_s: float) -> tuple[float, float]:
    """A circle, so that an old setpoint is none of the new ones."""
    return 2.0 * math.cos(TURN_RAD_S * time_s), 2.0 * math.sin(TURN_RAD_S * time_s)


def _watched(
    told: list[str], *, share: float = 1.0, cut_s: float = math.inf, parameters: dict[str, float] | None = None
) -> SetpointWatch:
    """Five seconds and one more: setpoints 20 times a second of which none arrives after ``cut_s``; half as many told
    of, 0.3 s later.
    """
    watch = SetpointWatch(told.append, parameters or {})
    for tick in range(120):
        now_s = 0.05 * tick
        watch.sent(now_s, *_asked(now_s))
        if tick % 2 and now_s > 0.3:
            north, east = _asked(min(now_s - 0.3, cut_s))
            watch.followed(now_s, share * north, share * east, offboard=True)
    return watch


@pytest.mark.parametrize("parameters", [{}, {"MPC_XY_VEL_MAX": 1.2}])
def test_what_the_autopilot_clips_is_said_once_and_nobody_is_accused(parameters: dict[str, float]) -> None:
    told: list[str] = []
    assert _watched(told, share=0.6, parameters=parameters).seen is None
    how = "is 1.2" if parameters else "may limit it"
    assert len(told) == 1 and f"1.2 instead of 2.0 m/s: its MPC_XY_VEL_MAX {how}" in told[0]


def test_what_is_shorter_than_the_known_limit_is_somebody_elses() -> None:
    told: list[str] = []
    seen = _watched(told, share=0.6, parameters={"MPC_XY_VEL_MAX": 12.0}).seen
    assert seen is not None
    assert "another program sends setpoints" in seen
    assert told == []


@pytest.mark.parametrize("share", [0.0, -1.0])
def test_standstill_and_the_opposite_are_not_clipped(share: float) -> None:
    assert _watched([], share=share).seen is not None


def test_during_a_gap_that_the_autopilot_bridges_the_last_setpoint_that_arrived_is_flockds() -> None:
    """It flies on with that for a second, COM_OF_LOSS_T, and tells of it 0.6 s later over a slow link."""
    assert _watched([], cut_s=5.95 - 1.6).seen is None
