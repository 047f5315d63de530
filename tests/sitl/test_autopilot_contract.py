"""What flockd sees of PX4 SITL 1.18, message by message, is what it sees of the fake autopilot."""

from __future__ import annotations

import pytest

from tests.sitl.sitl_run import PX4
from tests.sitl.stories import seen

NO_SETPOINTS = (
    "it receives no setpoints, as flockd sends none yet; fly in Hold or Position until flockd's state is ready, then "
    "switch to offboard"
)
CHANGED = "the autopilot's COM_OF_LOSS_T is 20: its failsafe would act that long after"
FOREIGN = "another program sends setpoints: the autopilot follows 0.0 m/s north and 3.0 m/s east, which flockd did not"
SEEN = (
    ("start: checks told", "nothing against arming"),
    ("start: announced", "flockd announces itself"),
    ("arm in Land mode", "the refusal is shown before it is asked"),
    ("arm in Land mode", "it cannot be armed in its flight mode; select another mode first, as Hold or Position"),
    ("two events lost", "the list is asked for anew, and whole"),
    ("arm", "accepted"),
    ("take off", "accepted"),
    ("take off", "in the air"),
    ("offboard without setpoints", f"refused for now: {NO_SETPOINTS}"),
    ("offboard", "accepted"),
    ("offboard", "the mode is offboard"),
    ("offboard", "foreign setpoints: None"),
    ("every third heartbeat lost", "flown on"),
    ("every third heartbeat lost", "counted"),
    ("setpoints stop", "the mode is hold"),
    ("setpoints stop", "it is in its failsafe"),
    ("setpoints stop", "said: Failsafe activated"),
    ("setpoints come back", "back in offboard by itself"),
    ("Hold selected in the failsafe", "the failsafe is over"),
    ("Acro in the air", "refused for now without a reason; wait a few seconds and ask again"),
    ("Acro for a station", "said: Switching to Acro is currently not available"),
    ("foreign setpoints", "noticed"),
    ("foreign setpoints", FOREIGN),
    ("foreign setpoints", "over"),
    ("COM_OF_LOSS_T 20", "noticed"),
    ("COM_OF_LOSS_T 20", CHANGED),
    ("COM_OF_LOSS_T 1", "over"),
    ("NAV_DLL_ACT 2", "flockd does not announce itself any more"),
    ("NAV_DLL_ACT 0", "it does again"),
    ("text", "it is whole"),
    ("land", "accepted"),
    ("land", "the mode is land"),
    ("land", "disarmed on the ground, in mode hold"),
    ("restart", "noticed by its clock"),
    ("restart", "its streams come as requested"),
)
"""Of PX4 1.18 (release/1.18, 83c4f4e580) on 24 November 2026: the story, and what is seen."""


@pytest.mark.fault("heartbeats-lost")
@pytest.mark.fault("failsafe-then-resume")
@pytest.mark.fault("others-interfere")
@pytest.mark.fault("silent-autopilot")
@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["fake", pytest.param("px4", marks=PX4)])
def test_flockd_sees_what_px4_1_18_shows(autopilot: str) -> None:
    rows = seen(autopilot)
    assert [row.story for row in rows] == [story for story, _ in SEEN], rows
    for row, (_, what) in zip(rows, SEEN, strict=True):
        assert what in row.what and not row.what.startswith("never: "), row
