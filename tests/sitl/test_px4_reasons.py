"""Reasons that PX4 itself refuses for, as `flockd status` shows them; and the tool without PX4."""

from __future__ import annotations

import os

import pytest

from flockd.onboard.autopilot.refusal_reasons import REASONS
from tools.checks.px4_reasons import PROVOCATIONS, Provocation, Result, _row, run

PX4 = pytest.mark.skipif("FLOCKD_PX4" not in os.environ, reason="FLOCKD_PX4 names no SITL build folder of PX4")


@PX4
@pytest.mark.slow
@pytest.mark.parametrize("provocation", PROVOCATIONS, ids=lambda provocation: provocation.name)
def test_status_shows_what_px4_refuses_for(provocation: Provocation) -> None:
    (result,) = run([provocation], 0, lambda result: None)
    assert result.kept, result
    assert REASONS[provocation.reason].what in result.status_shows
    assert REASONS[provocation.reason].remedy in result.status_shows


def test_every_provocation_is_of_a_reason_in_the_table() -> None:
    names = [provocation.name for provocation in PROVOCATIONS]
    assert len(set(names)) == len(names) >= 12
    assert {provocation.reason for provocation in PROVOCATIONS} <= REASONS.keys()


def test_a_reason_that_was_not_shown_or_stays_is_not_kept() -> None:
    result = Result("no_home", "`COM_HOME_EN` 0", "", "", None, gone=True)
    assert not result.kept
    assert _row(result) == "| no_home | `COM_HOME_EN` 0 | (an event) | NOT SHOWN | None |"
    assert not Result("no_home", "`COM_HOME_EN` 0", "", "the autopilot refuses to arm: ...", 1.2, gone=False).kept
    assert Result("no_home", "`COM_HOME_EN` 0", "", "the autopilot refuses to arm: ...", 1.2, gone=True).kept
