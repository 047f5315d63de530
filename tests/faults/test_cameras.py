"""Faults of cameras, while a whole drone flies."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flockd.core.messages import Frame
from flockd.core.navigation import wrapped
from tests.calm import clock
from tests.faults.conftest import InTheAir
from tests.faults.process import Process, flying
from tests.faults.stories import Reacted
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import CAMERAS, SECONDS_TO_FAIL, Watched

pytestmark = pytest.mark.slow
NOTICED_S = 0.8
"""Three frame periods at 5 Hz, and some."""
STANDS_S = 0.8
"""From when a camera counts as lost: to notice, and to brake from 1 m/s."""


@pytest.mark.fault("camera-unplugged", within_s=3.0)
@pytest.mark.fault("frozen-frames", within_s=3.0)
@pytest.mark.parametrize("fault", ["camera-unplugged", "frozen-frames"])
async def test_no_camera_delivers_anything_new(fault: str, in_flight: InTheAir, reacted: Reacted) -> None:
    async with in_flight() as ship:
        repeated_s: list[float] = []

        def frozen(frame: Frame) -> Frame:
            repeated_s.append(clock())
            return replace(frame, sequence=17)

        if fault == "camera-unplugged":
            ship.cameras.silent |= set(CAMERAS)
        else:
            ship.cameras.spoil = frozen
        fault_s = clock()
        await ship.until_mode()
        held_s = clock()
        reacted(fault, held_s - fault_s)
        assert not ship.fake_autopilot.failsafe, "it was asked for Hold, not left to its failsafe"
        # After three periods, or five repeats, however late a busy computer sends them.
        lost_s = fault_s + 0.6 if fault == "camera-unplugged" else repeated_s[6 * len(CAMERAS) - 1]
        # Hold, after which no setpoints are sent, may come first.
        assert ship.standing_still(min(lost_s + STANDS_S, held_s - 0.1))
        why = "front silent, back silent" if fault == "camera-unplugged" else "front frozen, back frozen"
        await ship.until_event(f"hover: too few cameras deliver images: {why}")
        await ship.until_event("silent: ")
        async with ship.sends_nothing():
            ship.cameras.silent.clear()
            _good_again(ship)
            await until(lambda: _all_see(ship), SECONDS_TO_FAIL)
            await ship.until_state("silent")
        assert (await ship.ask("ask/resume"))["accepted"] is True
        await ship.until_state("ready")


def _stamped_back(frame: Frame) -> Frame:
    return frame if frame.sequence % 2 else replace(frame, time_s=frame.time_s - 3.0)


def _cut_off(frame: Frame) -> Frame:
    return frame if frame.sequence % 2 else replace(frame, image=frame.image[:7])


@pytest.mark.fault("time-stamps-backwards", within_s=5.0)
@pytest.mark.fault("damaged-images", within_s=6.0)
@pytest.mark.parametrize(
    ("fault", "spoil", "counts"),
    [
        ("time-stamps-backwards", _stamped_back, ("time_stamp",)),
        ("damaged-images", _cut_off, ("malformed", "corrupt")),
    ],
)
async def test_every_second_frame_is_worth_nothing(
    fault: str, spoil: Callable[[Frame], Frame], counts: tuple[str, ...], in_flight: InTheAir, reacted: Reacted
) -> None:
    """They are dropped and counted, and the drone flies on, slower, by the others."""
    async with in_flight() as ship:
        ship.cameras.spoil = spoil
        fault_s = clock()
        await ship.until_matters("frames_dropped")
        reacted(fault, clock() - fault_s)
        await ship.steps_on(3)
        assert ship.fake_autopilot.mode == "OFFBOARD"
        assert sum(_counted(ship, "front", what) for what in counts) > 1
        _good_again(ship)
        await ship.until_matters(over=("frames_dropped",))
        await ship.until_state("normal")


@pytest.mark.fault("one-camera-gone", within_s=2.0)
async def test_one_of_two_cameras_is_gone_and_comes_back(in_flight: InTheAir, reacted: Reacted) -> None:
    async with in_flight() as ship:
        ship.cameras.silent.add("back")
        fault_s = clock()
        await ship.until_event("degraded: a camera is lost: back silent")
        reacted("one-camera-gone", clock() - fault_s)
        await ship.steps_on(3)
        assert ship.fake_autopilot.mode == "OFFBOARD"
        await ship.until_matters("camera_lost")  # as often as it is published
        ship.cameras.silent.clear()
        await ship.until_matters(over=("camera_lost",))
        await ship.until_state("normal")


@pytest.mark.fault("blind-sector", within_s=4.5)
async def test_the_camera_ahead_is_gone_for_good(in_flight: InTheAir, reacted: Reacted) -> None:
    """The drone flies north and is slower, then stands, and turns: the other camera of the two looks back."""
    async with in_flight() as ship:
        await until(lambda: ship.speed() > 0.5, SECONDS_TO_FAIL)
        heading_rad = ship.fake_autopilot.setpoints[-1][1].yaw_rad
        ship.cameras.silent.add("front")
        fault_s = clock()
        await until(lambda: float(np.hypot(*ship.fake_autopilot.setpoints[-1][1].velocity)) < 0.01, SECONDS_TO_FAIL)
        reacted("blind-sector", clock() - fault_s)
        turned_rad = abs(wrapped(ship.fake_autopilot.setpoints[-1][1].yaw_rad - heading_rad))
        assert turned_rad == pytest.approx(0.2 * (clock() - fault_s), abs=0.3)
        assert ship.fake_autopilot.mode == "OFFBOARD"


@pytest.mark.fault("time-stamps-jump", within_s=4.0)
async def test_a_frame_of_another_time_silences_nobody(in_flight: InTheAir, reacted: Reacted) -> None:
    """Three frames of one camera; all good ones after it are used at once."""
    spoiled: list[float] = []

    def of_another_time(frame: Frame) -> Frame:
        if frame.camera != "front" or len(spoiled) >= 3:
            return frame
        spoiled.append(clock())
        return replace(frame, time_s=frame.time_s + 3.0)

    async with in_flight() as ship:
        steps = ship.heard()["computer"].message["steps"]
        ship.cameras.spoil = of_another_time
        await until(lambda: len(spoiled) == 3, SECONDS_TO_FAIL)
        await until(lambda: _counted(ship, "front", "time_stamp") == 3, SECONDS_TO_FAIL)
        await until(lambda: ship.heard()["computer"].message["steps"] > steps + 4, SECONDS_TO_FAIL)
        await until(lambda: _all_see(ship), SECONDS_TO_FAIL)
        reacted("time-stamps-jump", clock() - spoiled[-1])
        assert ship.fake_autopilot.mode == "OFFBOARD"
        await ship.until_state("normal")


@pytest.mark.fault("noisy-camera", within_s=4.0)
async def test_a_camera_shows_noise(tmp_path: Path, reacted: Reacted) -> None:
    """It counts as lost, invents no neighbour, and the command stays what the other camera gives: 1 m/s north."""
    async with flying(tmp_path) as process:
        await until(lambda: _speed_north(process) > 0.97, SECONDS_TO_FAIL)
        process.cameras.noisy.add("back")
        fault_s = time.monotonic()
        lost = False
        while not lost or time.monotonic() < fault_s + 5.0:
            assert not any(n["confirmed"] for n in process.heard()["neighbours"].message["neighbours"])
            assert abs(_speed_north(process) - 1.0) < 0.1
            if not lost and any(event.startswith("degraded: a camera is lost: back") for event in process.events):
                lost = True
                reacted("noisy-camera", time.monotonic() - fault_s)
            assert time.monotonic() < fault_s + SECONDS_TO_FAIL
            await asyncio.sleep(0.05)
        assert process.fake_autopilot.mode == "OFFBOARD"
        process.cameras.noisy.clear()
        await process.until_matters(over=("camera_lost",))


def _speed_north(process: Process) -> float:
    return float(process.heard()["command"].message["velocity_ne"][0])


def _counted(ship: Watched, camera: str, what: str) -> int:
    return int(ship.heard()["computer"].message["cameras"][camera]["counts"].get(what, 0))


def _all_see(ship: Watched) -> bool:
    cameras = ship.heard()["computer"].message["cameras"].values()
    return all(camera["fault"] is None and camera["age_s"] < NOTICED_S for camera in cameras)


def _good_again(ship: Watched) -> None:
    ship.cameras.spoil = lambda frame: frame
