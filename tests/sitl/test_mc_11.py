"""PX4's flight-test card MC_11, step by step, with offboard in the place of its external mode.

The card is PX4's `docs/en/test_cards/mc_11_companion_ros2_external_mode.md`. It is about a ROS 2 external mode; here
MAVLink's offboard is in its place.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flockd.core.errors import UnavailableError
from flockd.core.messages import FloatArray
from flockd.sim.sitl.ground_station import Mode
from flockd.sim.sitl.ports import free_port
from flockd.sim.sitl.processes import Programs
from tests.sitl.stories import (
    HEIGHT_M,
    START_S,
    Row,
    Stories,
    World,
    landing,
    offboard_possible,
    seen,
    take_off,
)

CORNERS_M = np.array([(2.0, 0.0), (2.0, 3.0), (0.0, 0.0)])
"""A tenth of the card's triangle: to the north, to the east, and back, from where offboard is engaged."""
SPEED_M_S, GAIN_HZ, ARRIVED_M = 2.0, 1.5, 0.3
WITHIN_M = 1.0
"""The true place of a corner, and the height: as far as PX4's simulated satellites let it."""
AWAY_M = 2.0
STICK, OVERRIDE_S, TRIES = 700, 3.0, 5
LOSS_S, MAX_GAP_S, QUIET_S = 2.0, 0.9, 2.5
"""COM_OF_LOSS_T and flockd's own limit, long for a busy computer; and for how long nothing may happen: longer."""
ROOT = Path(__file__).parents[2]


async def start_companion(world: World) -> None:
    """The process that is killed later: it waits for an autopilot at a port of its own, which none sends to yet."""
    log = Path(world.stack.enter_context(tempfile.TemporaryDirectory(prefix="mc-11-"))) / "companion.log"
    port, programs = free_port(), world.stack.enter_context(Programs())
    command = [sys.executable, "-m", "tests.sitl.companion", str(port), f"{world.speed_factor:g}", "1"]
    world.companion = port, programs.start("companion", command, os.environ, ROOT, log)


async def registration(world: World) -> None:
    """Disarmed: offboard can be selected while flockd streams, and only then."""
    story, link = "registration", world.link
    world.station.set_parameter(0, "COM_OF_LOSS_T", LOSS_S)
    await world.until(lambda: link.knows_checks() and not link.refusals(), "the checks")
    world.streamer.begin()
    await world.saw(story, lambda: offboard_possible(link), "offboard can be selected")
    world.streamer.end("by the story")
    await world.saw(story, lambda: not offboard_possible(link), "flockd silent: it cannot")
    world.streamer.begin()
    await world.saw(story, lambda: offboard_possible(link), "flockd streams again: it can")
    world.streamer.end("by the story")


async def engage(world: World) -> None:
    """And the pattern, and back to Hold."""
    await _engaged(world, "engage")
    await _pattern(world, "pattern")
    world.station.select(0, "LOITER")
    await world.saw("disengage", world.mode("hold"), "the mode is hold")
    await world.until(_flies(world, "LOITER"), "Hold, as the ground station hears it")
    await _silent_for_good(world, "disengage")


async def takeover(world: World) -> None:
    """The sticks are moved in offboard flight, and the pilot flies on."""
    story = "takeover by sticks"
    world.wanted = lambda: np.zeros(2)
    await _engaged(world, None)
    begun = world.clock()
    for _ in range(TRIES):  # a computer that is slow to send them makes the sticks slow
        world.stick = STICK
        if await _comes(world, world.mode("position"), OVERRIDE_S):
            world.rows.append(Row(story, "the mode is position", round(world.clock() - begun, 2)))
            break
        world.stick = 0
        await _comes(world, lambda: False, 1.0)
    await world.until(_flies(world, "POSCTL"), "Position, as the ground station hears it")
    await _silent_for_good(world, story)
    sent, place = world.streamer.report().sent, _place(world)
    world.stick = STICK
    await world.saw(story, lambda: _far(world, place) > AWAY_M, f"{AWAY_M:g} m flown by hand")
    world.rows.append(Row(story, f"setpoints meanwhile: {world.streamer.report().sent - sent}"))
    world.stick = 0
    await world.until(lambda: float(np.linalg.norm(world.station.poses().velocity[0])) < 0.3, "standstill")


async def engage_elsewhere(world: World) -> None:
    """At the place where the pilot has brought it."""
    await _engaged(world, "re-engage elsewhere")
    await _pattern(world, "the same pattern")
    await world.hold()


async def node_killed(world: World) -> None:
    """A process of its own flies, and is gone at once."""
    story, own = "node killed", world.relay.companion_port
    assert world.companion is not None
    port, companion = world.companion
    world.relay.companion_port = port
    await world.until(lambda: "streaming" in companion.log.read_text(), "a setpoint", START_S)
    for _ in range(TRIES):
        world.station.select(0, "OFFBOARD")
        if await _comes(world, _flies(world, "OFFBOARD"), 1.0):
            break
    place, told = _place(world), _failsafes_told(world)
    await world.saw(story, lambda: _far(world, place) > AWAY_M, f"{AWAY_M:g} m flown by the process")
    os.killpg(companion.process.pid, signal.SIGKILL)
    await world.saw(story, _flies(world, "LOITER"), "the mode is hold")
    await world.saw(story, lambda: _failsafes_told(world) > told, "a ground station is told: Failsafe activated")
    world.relay.companion_port = own
    await world.until(lambda: world.link.status().heartbeat_age_s < 1.0, "a heartbeat")
    world.station.select(0, "LOITER")
    await world.until(lambda: not world.link.status().failsafe, "the end of the failsafe")


async def link_lost(world: World) -> None:
    """Nothing passes between the autopilot and flockd, and then all again."""
    story = "link lost"
    await _engaged(world, None)
    world.relay.cut = True
    await world.saw(story, _flies(world, "LOITER"), "the mode is hold")
    await world.saw(story, lambda: world.streamer.report().fault is not None, "flockd has noticed, and ends its stream")
    world.relay.cut = False
    await world.saw(story, lambda: world.link.status().heartbeat_age_s < 1.0, "the link is back")
    await _silent_for_good(world, story)
    await world.hold()


async def _engaged(world: World, story: str | None) -> None:
    """Streams, and a ground station selects offboard, once; rows where it is a story."""
    world.streamer.begin()
    sent = world.streamer.report().sent
    await world.until(lambda: world.streamer.report().sent > sent + 10, "a stream")
    await world.until(lambda: offboard_possible(world.link), "a report that offboard is possible")
    world.texts()
    world.station.select(0, "OFFBOARD")
    if story is None:
        await world.until(world.mode("offboard"), "offboard")
        return
    await world.saw(story, world.mode("offboard"), "the mode is offboard at the first request")
    refusals = [text for text in world.texts() if "not available" in text or "denied" in text]
    world.rows.append(Row(story, "; ".join(refusals) or "no refusal is said"))


async def _pattern(world: World, story: str) -> None:
    """Corner by corner, from here."""
    place, begun, heights = _estimate(world), _place(world), [HEIGHT_M]
    for name, corner in zip(("north", "east", "back"), CORNERS_M, strict=True):

        def wanted(corner: FloatArray = corner) -> FloatArray:
            heights.append(-float(world.station.poses().position[0, 2]))
            way = GAIN_HZ * (place + corner - _estimate(world))
            return way * min(1.0, SPEED_M_S / max(float(np.linalg.norm(way)), 1e-9))

        def there(corner: FloatArray = corner) -> bool:
            return float(np.linalg.norm(place + corner - _estimate(world))) < ARRIVED_M

        world.wanted = wanted
        await world.saw(story, there, f"{name}: the corner by the autopilot's estimate")
        off_m = float(np.linalg.norm(begun + corner - _place(world)))
        truly = "and in truth" if off_m < WITHIN_M else f"but in truth {off_m:.1f} m beside it"
        world.rows.append(Row(story, f"{name}: {truly}"))
    world.wanted = lambda: np.zeros(2)
    off_m = max(abs(height - HEIGHT_M) for height in heights)
    world.rows.append(Row(story, "the height is kept" if off_m < WITHIN_M else f"the height is {off_m:.1f} m off"))


async def _silent_for_good(world: World, story: str) -> None:
    """Watches for a while that flockd sends nothing and that the mode stays."""
    report, mode = world.streamer.report(), world.station.mode(0)
    await _comes(world, lambda: False, QUIET_S)
    silent = not world.streamer.report().streaming and world.streamer.report().sent == report.sent
    stays = world.station.mode(0) == mode
    world.rows.append(
        Row(story, f"flockd {'is silent' if silent else 'SENDS'}, and the mode {'stays' if stays else 'CHANGES'}")
    )


async def _comes(world: World, condition: Callable[[], bool], within_s: float) -> bool:
    """Whether it holds within that time."""
    try:
        await world.until(condition, "it", within_s)
    except UnavailableError:
        return False
    return True


def _flies(world: World, mode: Mode) -> Callable[[], bool]:
    """As a ground station sees it: flockd may not hear the autopilot."""
    return lambda: world.station.mode_is(0, mode)


def _failsafes_told(world: World) -> int:
    """How often a ground station was told of one."""
    return sum("Failsafe activated" in text for text in world.station.texts(0))


def _place(world: World) -> FloatArray:
    """(2,) metres, the truth."""
    return world.station.poses().position[0, :2].copy()


def _far(world: World, place: FloatArray) -> float:
    return float(np.linalg.norm(_place(world) - place))


def _estimate(world: World) -> FloatArray:
    """(2,) metres, the autopilot's own."""
    state = world.link.vehicle_state()
    if state is None or state.position is None:
        raise UnavailableError("the autopilot tells no position")
    return np.asarray(state.position)


MC_11 = Stories(
    (start_companion, registration, take_off, engage, takeover, engage_elsewhere, node_killed, link_lost, landing),
    remote_control=True,
    max_gap_s=MAX_GAP_S,
)


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


@pytest.mark.slow
@pytest.mark.whole_flight
@pytest.mark.parametrize(("autopilot", "speed_factor"), [("fake", 2.0), pytest.param("px4", 1.0, marks=PX4)])
def test_every_step_of_px4s_card_goes_as_it_asks(autopilot: str, speed_factor: float) -> None:
    rows = seen(autopilot, MC_11, speed_factor)
    assert [(row.story, row.what) for row in rows] == list(STEPS)
