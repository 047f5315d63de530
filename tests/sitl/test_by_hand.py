"""A pilot flies by hand before a wall that flockd tells of: the fake autopilot and PX4 do the same.

flockd's link sends OBSTACLE_DISTANCE of a made-up map: a wall to the north, and nothing known behind. PX4's Collision
Prevention stops the pilot. A text of flockd's is awaited where a ground station listens.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import numpy as np
import pytest

from flockd.core import services
from flockd.core.messages import SECTORS, ObstacleRanges
from flockd.flight.obstacles import free_ahead, nearest_points
from flockd.onboard.autopilot.mavsdk_link import Severity
from tests.sitl.sitl_run import PX4, Meddler
from tests.sitl.stories import Row, World, landing, seen, take_off

GROUND_STATION_PORT = 14550
"""Where PX4's instance 0 looks for one."""
WALL_M, KEEP_M, RANGE_M = 9.0, 3.0, 15.0
"""North of where the story begins; CP_DIST; and `obstacles.range_m`."""
WITHIN_M = 1.0
"""Of PX4's simulated truth, as far as its satellites let it."""
STICK, PUSH_S, STILL_M_S, AWAY_M = 700, 3.0, 0.2, 0.5
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


async def blind(world: World) -> None:
    """What a pilot has who sets CP_DIST without a source."""
    world.station.set_parameter(0, "CP_DIST", KEEP_M)
    await _wait(world, 6.0)  # PX4 tolerates five seconds after it was switched on
    world.station.select(0, "POSCTL")
    await _pushed(world, "blind", STICK)
    await world.saw("blind", world.mode("hold"), "the mode is hold")


async def wall(world: World) -> None:
    """And backwards, where nothing is known; then the distances end."""
    place_m = _north_m(world) + WALL_M
    async with _told(world, place_m):
        await asyncio.sleep(0.5)
        world.station.select(0, "POSCTL")
        await world.until(world.mode("position"), "Position mode")
        world.stick = STICK
        begun_m = _north_m(world)
        await world.saw("wall", lambda: _north_m(world) > begun_m + 3.0, "3 m flown")
        await world.saw("wall", _still(world), "it stands, the stick still forward")
        await _wait(world, PUSH_S)
        left_m = place_m - _north_m(world)
        near = abs(left_m - KEEP_M) < WITHIN_M
        world.rows.append(Row("wall", "CP_DIST before the wall" if near else f"{left_m:.1f} m before the wall"))
        world.stick = 0
        await _pushed(world, "unknown", -STICK)
        same = "the mode is still position" if world.mode("position")() else "the mode CHANGES"
        world.rows.append(Row("unknown", same))
    await asyncio.sleep(services.OBSTACLE_DISTANCE.timeout + 0.2)
    await _pushed(world, "old", -STICK, PUSH_S / 2)
    await world.saw("old", world.mode("hold"), "the mode is hold")


@asynccontextmanager
async def _told(world: World, place_m: float) -> AsyncIterator[None]:
    """While flockd sees a wall at that place, and a third of the way around to each side of the nose."""

    async def tell() -> None:
        azimuths = 2 * np.pi / SECTORS * np.arange(SECTORS)
        ahead = np.cos(azimuths) > 0.5
        while True:
            away_m = (place_m - _north_m(world)) / np.where(ahead, np.cos(azimuths), np.nan)
            range_m = np.where(away_m <= RANGE_M, away_m, np.inf)
            seen_m = np.where(ahead, np.minimum(range_m, RANGE_M), 0.0)
            ranges = ObstacleRanges(world.clock(), range_m, np.zeros(SECTORS), seen_m)
            R = world.station.poses().R_ned_body[0]
            yaw_rad = math.atan2(R[1, 0], R[0, 0])
            world.link.send_obstacle_distances(
                free_ahead(nearest_points(ranges, 0.0), seen_m, 0.0, yaw_rad, RANGE_M), RANGE_M
            )
            await asyncio.sleep(services.OBSTACLE_DISTANCE.period_s / world.speed_factor)

    telling = asyncio.create_task(tell())
    try:
        yield
    finally:
        telling.cancel()


async def _pushed(world: World, story: str, stick: int, push_s: float = PUSH_S) -> None:
    """A row on whether the drone moves when the stick is held there for a while."""
    begun_m, world.stick = _north_m(world), stick
    await _wait(world, push_s)
    world.stick = 0
    moved_m = abs(_north_m(world) - begun_m)
    world.rows.append(Row(story, "the drone does not move" if moved_m < AWAY_M else f"the drone moves {moved_m:.1f} m"))


async def _wait(world: World, seconds: float) -> None:
    until_s = world.clock() + seconds
    await world.until(lambda: world.clock() >= until_s, "the time")


def _still(world: World) -> Callable[[], bool]:
    return lambda: float(np.linalg.norm(world.station.poses().velocity[0])) < STILL_M_S


def _north_m(world: World) -> float:
    """The truth."""
    return float(world.station.poses().position[0, 0])


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
    rows = seen(autopilot, (ready, take_off, text, blind, wall, landing), speed_factor, remote_control=True)
    assert [(row.story, row.what) for row in rows] == list(STEPS)
