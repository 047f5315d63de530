"""The daemon's stories: it starts, flies, and hands over whatever happens. The autopilot is a fake, not PX4."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.config.mission import MissionParameters, WaypointParameters
from flockd.core.messages import LearnedSize
from flockd.fleet.drone_rows import status_rows
from flockd.flight.pilot import FlockPilot
from flockd.onboard.daemon import DaemonError
from flockd.onboard.message_json import to_json
from flockd.onboard.recording.reader import Recording
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.processes import free_port
from tests.calm import clock
from tests.faults.stories import Reacted
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.autopilot.flight import Wire, until
from tests.onboard.daemon.aboard import CAMERAS, PATIENT, SECONDS_TO_FAIL, SPEED_M_S, STEP_S, TinyPerceiver, aboard

ALONE = PATIENT.model_copy(update={"alone_s": None})
"""Flies on without neighbours, however long this computer takes."""


async def test_from_the_ground_into_the_air_and_back_into_the_pilots_hands(tmp_path: Path) -> None:
    port = free_port()
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock) as fake_autopilot:
        async with aboard(fake_autopilot, port, tmp_path, height_m=HOVER_M + 0.5) as ship:
            await until(lambda: "READY=1" in ship.service, SECONDS_TO_FAIL)
            await ship.until_state("idle")
            await until(lambda: "started" not in ship.matters())  # it was seen disarmed on the ground
            assert not fake_autopilot.setpoints, "nothing is sent before it is ready"
            fake_autopilot.pilot_arms()
            fake_autopilot.pilot_selects("TAKEOFF")
            await ship.until_state("ready")
            await until(lambda: fake_autopilot.mode == "LOITER", SECONDS_TO_FAIL)
            await ship.flies()
            await ship.until_state("normal", "degraded")
            await until(lambda: ship.speed() > 0.9 * SPEED_M_S)
            np.testing.assert_allclose(
                fake_autopilot.state.velocity[:2], [SPEED_M_S, 0.0], atol=0.2
            )  # north: Eq. 43 at 0 s
            await until(lambda: abs(fake_autopilot.setpoints[-1][1].sink_m_s) < 0.05, SECONDS_TO_FAIL)
            assert -float(fake_autopilot.state.position[2]) == pytest.approx(HOVER_M + 0.5, abs=0.2), "as configured"
            _tells_what_it_does(ship.heard())
            assert ship.service.count("WATCHDOG=1") >= 4

            fake_autopilot.pilot_selects("POSCTL")
            await ship.until_state("silent")
            before = len(fake_autopilot.setpoints)
            await asyncio.sleep(0.5)
            assert len(fake_autopilot.setpoints) == before
            assert "not_offboard" in ship.matters()
            assert fake_autopilot.mode == "POSCTL"


def _tells_what_it_does(heard: object) -> None:
    assert isinstance(heard, dict)
    assert {"state", "neighbours", "command", "flight", "computer", "events"} <= heard.keys()
    flight, computer = heard["flight"].message, heard["computer"].message
    assert (flight["flight_mode"], flight["armed"], flight["in_air"]) == ("offboard", True, True)
    assert flight["silence"] is None
    assert flight["setpoints_sent"] > 0
    assert flight["battery_share"] == 1.0
    assert set(computer["cameras"]) == {"front", "back"}
    assert computer["cameras"]["front"]["fault"] is None
    assert computer["cameras"]["front"]["counts"]["used"] > 0
    assert computer["steps"] > 0
    assert computer["recording"] is None
    assert np.linalg.norm(heard["command"].message["velocity_ne"]) == pytest.approx(SPEED_M_S, abs=0.2)


async def test_eyes_that_lie_about_the_own_motion_add_half_a_metre_a_second_at_most_and_nothing_to_a_hover(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot
) -> None:
    """They see a standstill, whatever is flown: the trim is at its limit, and no farther."""
    fake_autopilot.drifts = False
    async with aboard(fake_autopilot, port, tmp_path, own_velocity="vision") as ship:
        await ship.is_ready_in_the_air()
        await until(lambda: len(fake_autopilot.setpoints) > 5, SECONDS_TO_FAIL)
        fake_autopilot.pilot_selects("OFFBOARD")
        chosen_s = clock()
        await until(lambda: ship.heard()["flight"].message["velocity_trim"][0] > 0.49, SECONDS_TO_FAIL)
        off_s = next(at_s for at_s, sent in list(fake_autopilot.setpoints) if np.linalg.norm(sent.velocity) > 0.01)
        assert off_s - chosen_s > 2 * STEP_S - 0.1, "a neighbour counts from its third look on"
        await asyncio.sleep(1.0)
        commanded = np.array(ship.heard()["command"].message["velocity_ne"])
        trim = np.array(ship.heard()["flight"].message["velocity_trim"])
        np.testing.assert_allclose(trim, [0.5, 0.0], atol=0.02)
        assert np.linalg.norm(commanded - trim) < 0.9 * SPEED_M_S, "it believes that it stands"

        def is_sent() -> bool:
            commanded = ship.heard()["command"].message["velocity_ne"]
            return np.allclose(fake_autopilot.setpoints[-1][1].velocity[:2], commanded, atol=0.02)

        await until(is_sent, SECONDS_TO_FAIL)

        ship.cameras.silent |= set(CAMERAS)
        silent_s = clock()
        await until(lambda: fake_autopilot.mode == "LOITER", SECONDS_TO_FAIL)
        hover = [sent for at_s, sent in list(fake_autopilot.setpoints) if at_s > silent_s + 1.2]
        assert hover, "the hover is sent"
        assert np.linalg.norm(hover[-1].velocity) < 0.1, "standstill at last, however late it was noticed"


@pytest.mark.fault("battery-or-estimate")
async def test_a_position_and_velocity_that_come_no_more_are_not_flown_by(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot
) -> None:
    """Heartbeats and attitudes still come. The newest velocity would be taken for that of now, for ever."""
    async with aboard(fake_autopilot, port, tmp_path) as ship:
        await ship.is_ready_in_the_air()
        await ship.flies()
        await ship.until_state("normal")
        fake_autopilot.sends_motion = False
        gone_s = clock()
        await ship.until_event("hover: no position and velocity from the autopilot for ")
        await until(lambda: fake_autopilot.mode == "LOITER", SECONDS_TO_FAIL)
        assert 1.2 < fake_autopilot.setpoints[-1][0] - gone_s < 3.5, "until 0.5 s later, and for 1 s of hovering"
        last = [sent for at_s, sent in list(fake_autopilot.setpoints) if at_s > gone_s + 1.2]
        assert max(np.linalg.norm(sent.velocity) for sent in last) < 0.1
        assert not fake_autopilot.failsafe


@pytest.mark.fault("home-moved")
async def test_a_second_sender_with_the_autopilots_ids_moves_neither_height_band_nor_fence(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot
) -> None:
    """Home half a kilometre away and 20 m deeper, and the drone on the ground: outside of both, if it were believed."""
    async with aboard(fake_autopilot, port, tmp_path) as ship:
        await ship.is_ready_in_the_air()
        await ship.flies()
        forged = mavlink.MAVLink(Wire(port), srcSystem=1, srcComponent=1)
        for _ in range(10):
            forged.extended_sys_state_send(0, mavlink.MAV_LANDED_STATE_ON_GROUND)
            forged.home_position_send(0, 0, 0, 500.0, 0.0, 20.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)
            await asyncio.sleep(0.1)
        await ship.until_event("the autopilot's home moved by 500.4 m in flight")  # sqrt(500^2 + 20^2)
        await ship.until_event("the autopilot reports that the drone is on the ground")
        assert not {"fence_left", "heights_left"} & ship.matters()
        assert ship.state() in {"normal", "degraded"}
        assert fake_autopilot.mode == "OFFBOARD"
        assert fake_autopilot.setpoints[-1][1].sink_m_s == pytest.approx(0.0, abs=0.05)


def _replays_to_the_last_bit(recording: Recording) -> None:
    """A recording begins with the flight's own pilot, so that another one can compute the same again."""
    assert recording.contents.finished
    assert recording.contents.models == {"tiny": "0" * 64}
    steps = list(recording.steps())
    assert len(steps) > 5
    perceiver = TinyPerceiver()
    pilot = FlockPilot(recording.config, perceiver, learned=recording.learned)
    for step in steps:
        assert step.output is not None
        perceiver.not_finite = sum("is not finite" in reason for reason in step.output["reasons"])
        again = to_json(pilot.step(step.frames, step.vehicle, order=step.order))
        assert {**again, "stages_ms": None} == {**step.output, "stages_ms": None}


async def test_an_operator_sends_it_somewhere_and_the_recording_replays(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Also what its pilot began with of the others' size, which the one before it learned."""
    learned = LearnedSize(0.43, 0.08)
    monkeypatch.setattr(FlockPilot, "learned", learned)
    monkeypatch.setattr("flockd.cli.fleet.FIND_S", SECONDS_TO_FAIL)
    async with aboard(
        fake_autopilot,
        port,
        tmp_path,
        recordings=tmp_path,
        change=lambda config: config.model_copy(update={"safety": ALONE}),
    ) as ship:
        await ship.is_ready_in_the_air()
        assert await ship.fleet("goto", "tiny", "1", "0") == 1, "flockd does not fly it yet"
        await ship.flies()
        assert await ship.fleet("goto", "tiny", "300", "0") == 1
        assert ship.mission("kind") == "circle_then_tangent", "nothing has changed"
        north, east = fake_autopilot.state.position[:2] - [0.0, 2.0]
        command = ("goto", "tiny", f"{north:.3f}", f"{east:.3f}", "--height", f"{HOVER_M + 1.0}", "--speed", "1")
        assert await ship.fleet(*command) == 0
        await until(lambda: ship.mission("arrived") is True, SECONDS_TO_FAIL)
        await until(lambda: -fake_autopilot.state.position[2] > HOVER_M + 0.8, SECONDS_TO_FAIL)
        away = fake_autopilot.state.position[:2] - [north, east]
        assert float(np.linalg.norm(away)) < 1.5
        assert fake_autopilot.mode == "OFFBOARD"
        assert await ship.fleet("velocity", "tiny", "0.3", "0") == 0
        await until(lambda: str(ship.mission("sentence")).startswith("hovers until"), SECONDS_TO_FAIL)
    told = capsys.readouterr()
    assert "m from home, outside the fence of 100 m" in told.err
    assert "flockd does not fly the drone now" in told.err
    (path,) = tmp_path.glob("tiny-*.mcap")
    recording = Recording(path)
    assert recording.learned == learned
    _replays_to_the_last_bit(recording)
    orders = [step.order for step in recording.steps() if step.order is not None]
    assert [order.speed_m_s for order in orders] == [1.0, None]
    flown = [step.output["mission"]["sentence"] for step in recording.steps() if step.output is not None]
    assert "flies an operator's velocity" in flown, "for two seconds, in which a busy computer may show no telemetry"


@pytest.mark.parametrize(("end", "mode"), [("land", "LAND"), ("return", "RTL")])
async def test_at_its_end_a_mission_hands_over_to_the_autopilot(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot, end: Literal["land", "return"], mode: str
) -> None:
    goal = WaypointParameters(north_m=2.0, east_m=0.0)
    mission = MissionParameters(kind="waypoints", waypoints=(goal,), speed_m_s=1.0, at_end=end)
    async with aboard(
        fake_autopilot,
        port,
        tmp_path,
        change=lambda config: config.model_copy(update={"mission": mission, "safety": ALONE}),
    ) as ship:
        await ship.is_ready_in_the_air()
        await until(lambda: len(fake_autopilot.setpoints) > 5, SECONDS_TO_FAIL)
        fake_autopilot.pilot_selects("OFFBOARD")
        await ship.until_mode(mode)
        assert not fake_autopilot.failsafe
        await ship.until_event(f"asking: the mission is over and ends with {end.capitalize()}")
        await ship.until_state("silent", "idle")


@pytest.mark.fault("task-dies", within_s=2.0)
@pytest.mark.parametrize(
    ("task", "function"),
    [
        ("control", "flockd.onboard.daemon.control.Control.tick"),
        ("pilot", "flockd.onboard.daemon.pilot_loop.PilotLoop._step"),
        ("telemetry", "flockd.onboard.daemon.status._computer_message"),
    ],
)
async def test_a_dead_task_is_held_by_the_last_resort(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot, monkeypatch: pytest.MonkeyPatch, task: str,
    function: str, reacted: Reacted,
) -> None:  # fmt: skip
    async with aboard(fake_autopilot, port, tmp_path) as ship:
        await ship.is_ready_in_the_air()
        await ship.flies()

        def dies(*_: object) -> None:
            raise ArithmeticError("for the test")

        monkeypatch.setattr(function, dies)
        fault_s = clock()
        await ship.until_mode()
        reacted("task-dies", clock() - fault_s)
        assert not fake_autopilot.failsafe
        with pytest.raises(DaemonError, match=rf"{task}: ArithmeticError") as ended:
            await ship.ending
        assert ended.value.exit_code != 0


async def test_what_the_autopilot_refuses_is_in_status_word_for_word_and_once_in_the_log(
    tmp_path: Path, port: int
) -> None:
    sentence = "the autopilot refuses to arm: a gyroscope is not calibrated; calibrate it in the ground station"
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock) as fake_autopilot:
        async with aboard(fake_autopilot, port, tmp_path) as ship:
            await ship.until_state("idle")
            fake_autopilot.failing = {"check_gyro_not_calibrated"}
            await ship.until_event(sentence)
            await until(lambda: ship.refusals() == {"check_gyro_not_calibrated"}, SECONDS_TO_FAIL)
            (row,) = status_rows(ship.watcher.drones(), clock())
            assert sentence in row["matters"]
            fake_autopilot.failing = set()
            await until(lambda: not ship.refusals(), SECONDS_TO_FAIL)
            assert ship.events.count(sentence) == 1


async def test_it_says_what_it_flies_with_and_shows_what_its_cameras_see(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot
) -> None:
    async with aboard(fake_autopilot, port, tmp_path) as ship:
        await ship.until_state("idle")
        about = await ship.ask("about")
        assert about["configuration"]["name"] == "tiny"
        picture = cv2.imdecode(np.frombuffer(await ship.picture("front"), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape == (48, 64, 3)
        assert await ship.picture("bottom") == b"camera 'bottom' has no image"


async def test_it_can_be_told_to_stop_before_an_autopilot_is_heard(tmp_path: Path, port: int) -> None:
    silent = FakeAutopilot(port, clock=clock)  # never started
    async with aboard(silent, port, tmp_path) as ship:
        await asyncio.sleep(0.3)
        ship.daemon.ask_to_stop()
        async with asyncio.timeout(SECONDS_TO_FAIL):
            await ship.ending
