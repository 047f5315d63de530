"""Faults of cameras, while a whole drone flies: `flockd run` as a process of its own, with the shipped networks."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from flockd.core.messages import Frame
from tests.faults.process import Process, flying
from tests.faults.stories import Reacted
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import CAMERAS, SECONDS_TO_FAIL

pytestmark = pytest.mark.slow
NOTICED_S = 0.8
"""Three frame periods at 5 Hz, and some."""


@pytest.mark.fault("camera-unplugged", within_s=3.0)
@pytest.mark.fault("frozen-frames", within_s=3.0)
@pytest.mark.parametrize("fault", ["camera-unplugged", "frozen-frames"])
async def test_no_camera_delivers_anything_new(fault: str, tmp_path: Path, reacted: Reacted) -> None:
    async with flying(tmp_path) as process:
        if fault == "camera-unplugged":
            process.cameras.silent |= set(CAMERAS)
        else:
            process.cameras.spoil = lambda frame: replace(frame, sequence=17)
        fault_s = time.monotonic()
        await process.until_mode()
        reacted(fault, time.monotonic() - fault_s)
        assert not process.fake_autopilot.failsafe, "it was asked for Hold, not left to its failsafe"
        assert process.standing_still(fault_s + NOTICED_S + 0.3)
        why = "front silent, back silent" if fault == "camera-unplugged" else "front frozen, back frozen"
        await process.until_event(f"hover: too few cameras deliver images: {why}")
        await process.until_event("silent: ")
        async with process.sends_nothing():
            process.cameras.silent.clear()
            _good_again(process)
            await until(lambda: _all_see(process), SECONDS_TO_FAIL)
            await process.until_state("silent")
        assert (await process.ask("ask/resume"))["accepted"] is True
        await process.until_state("ready")


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
    fault: str, spoil: Callable[[Frame], Frame], counts: tuple[str, ...], tmp_path: Path, reacted: Reacted
) -> None:
    """They are dropped and counted, and the drone flies on, slower, by the others."""
    async with flying(tmp_path) as process:
        process.cameras.spoil = spoil
        fault_s = time.monotonic()
        await process.until_matters("frames_dropped")
        reacted(fault, time.monotonic() - fault_s)
        await process.steps_on(3)
        assert process.fake_autopilot.mode == "OFFBOARD"
        assert sum(_counted(process, "front", what) for what in counts) > 1
        _good_again(process)
        await process.until_matters(over=("frames_dropped",))
        await process.until_state("normal")


@pytest.mark.fault("one-camera-gone", within_s=2.0)
async def test_one_of_two_cameras_is_gone_and_comes_back(tmp_path: Path, reacted: Reacted) -> None:
    async with flying(tmp_path) as process:
        process.cameras.silent.add("back")
        fault_s = time.monotonic()
        await process.until_event("degraded: a camera is lost: back silent")
        reacted("one-camera-gone", time.monotonic() - fault_s)
        await process.steps_on(3)
        assert process.fake_autopilot.mode == "OFFBOARD"
        await process.until_matters("camera_lost")  # as often as it is published
        process.cameras.silent.clear()
        await process.until_matters(over=("camera_lost",))
        await process.until_state("normal")


@pytest.mark.fault("time-stamps-jump", within_s=4.0)
@pytest.mark.parametrize("ahead_s", [3.0, 86_400.0, -86_400.0, 1e300], ids=["3 s", "a day", "a day ago", "absurd"])
async def test_a_frame_of_another_time_silences_nobody(ahead_s: float, tmp_path: Path, reacted: Reacted) -> None:
    """Three frames of one camera; all good ones after it are used at once."""
    spoiled: list[float] = []

    def of_another_time(frame: Frame) -> Frame:
        if frame.camera != "front" or len(spoiled) >= 3:
            return frame
        spoiled.append(time.monotonic())
        return replace(frame, time_s=frame.time_s + ahead_s)

    async with flying(tmp_path) as process:
        steps = process.heard()["computer"].message["steps"]
        process.cameras.spoil = of_another_time
        await until(lambda: len(spoiled) == 3, SECONDS_TO_FAIL)
        await until(lambda: _counted(process, "front", "time_stamp") == 3, SECONDS_TO_FAIL)
        await until(lambda: process.heard()["computer"].message["steps"] > steps + 4, SECONDS_TO_FAIL)
        await until(lambda: _all_see(process), SECONDS_TO_FAIL)
        reacted("time-stamps-jump", time.monotonic() - spoiled[-1])
        assert process.fake_autopilot.mode == "OFFBOARD"
        await process.until_state("normal")


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


def _counted(process: Process, camera: str, what: str) -> int:
    return int(process.heard()["computer"].message["cameras"][camera]["counts"].get(what, 0))


def _all_see(process: Process) -> bool:
    cameras = process.heard()["computer"].message["cameras"].values()
    return all(camera["fault"] is None and camera["age_s"] < NOTICED_S for camera in cameras)


def _good_again(process: Process) -> None:
    process.cameras.spoil = lambda frame: frame
