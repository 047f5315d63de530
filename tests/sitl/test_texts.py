"""A text of flockd's is awaited where a ground station listens: the fake autopilot and PX4 pass it on."""

from __future__ import annotations

import asyncio

import pytest

from flockd.onboard.autopilot.mavsdk_link import Severity
from tests.sitl.sitl_run import PX4, Meddler
from tests.sitl.stories import World, landing, seen, take_off

GROUND_STATION_PORT = 14550
"""Where PX4's instance 0 looks for one."""
TEXT = "flockd hover: no camera has sent a usable frame for 1.2 s; 2 more reasons"


async def ready(world: World) -> None:
    """It knows where it is."""
    await world.until(lambda: world.link.knows_checks() and not world.link.refusals(), "nothing against arming", 60.0)


async def text(world: World) -> None:
    """PX4 forwards it to a ground station's link; the fake has one link for all."""
    with Meddler([GROUND_STATION_PORT], world.clock) as ground:
        await world.until(lambda: bool(ground.mode(0)) or world.station.is_connected(0), "a heartbeat")
        await asyncio.sleep(1.5)  # the autopilot has heard the ground station's heartbeat
        world.link.send_text(TEXT, Severity.WARNING)
        await world.saw("text", lambda: TEXT in {ground.last_text(0), world.station.last_text(0)}, "it is whole")


STEPS = (
    ("arm", "accepted"),
    ("take off", "accepted"),
    ("take off", "in the air"),
    ("text", "it is whole"),
    ("land", "accepted"),
    ("land", "the mode is land"),
    ("land", "disarmed on the ground, in mode hold"),
)


@pytest.mark.parametrize(("autopilot", "speed_factor"), [("fake", 3.0), pytest.param("px4", 1.0, marks=PX4)])
def test_a_text_reaches_the_ground_station_whole(autopilot: str, speed_factor: float) -> None:
    rows = seen(autopilot, (ready, take_off, text, landing), speed_factor, remote_control=True)
    assert [(row.story, row.what) for row in rows] == list(STEPS)
