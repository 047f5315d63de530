"""Faults of cameras, while a whole drone flies: `flockd run` as a process of its own, with the shipped networks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from flockd.messages import Frame
from tests.autopilot.flight import until
from tests.daemon.aboard import CAMERAS, SECONDS_TO_FAIL
from tests.faults.catalogue import RecordProperty, reacted
from tests.faults.process import Process, flying
from tests.starvation import tell

pytestmark = pytest.mark.slow
NOTICED_S = 0.8
"""Three frame periods at 5 Hz, and some."""


async def _is_held_and_stays_so(process: Process, fault_s: float, *, repair: Callable[[], None]) -> None:
    """Hold is asked for, standstill comes before it, and the drone does not come back by itself; an operator may."""
    assert not process.fake_autopilot.failsafe, "it was asked for Hold, not left to its failsafe"
    assert process.standing_still(fault_s + NOTICED_S + 0.3)
    await process.until_event("silent: ")
    assert any(event.startswith("hover: too few cameras deliver images") for event in process.events)
    before = len(process.fake_autopilot.setpoints)
    repair()
    await until(lambda: _all_see(process), SECONDS_TO_FAIL)
    assert process.state() == "silent"
    assert len(process.fake_autopilot.setpoints) == before
    assert (await process.ask("ask/resume"))["accepted"] is True
    await process.until_state("ready")


def test_no_camera_delivers_any_more(tmp_path: Path, record_property: RecordProperty) -> None:
    async def story() -> None:
        async with flying(tmp_path) as process:
            process.cameras.silent |= set(CAMERAS)
            fault_s = time.monotonic()
            await until(lambda: process.fake_autopilot.mode == "LOITER", SECONDS_TO_FAIL)
            reacted(record_property, "camera-unplugged", time.monotonic() - fault_s)
            await _is_held_and_stays_so(process, fault_s, repair=process.cameras.silent.clear)

    tell(story)


def test_all_cameras_freeze(tmp_path: Path, record_property: RecordProperty) -> None:
    async def story() -> None:
        async with flying(tmp_path) as process:
            process.cameras.spoil = lambda frame: replace(frame, sequence=17)
            fault_s = time.monotonic()
            await until(lambda: process.fake_autopilot.mode == "LOITER", SECONDS_TO_FAIL)
            reacted(record_property, "frozen-frames", time.monotonic() - fault_s)
            await process.until_event("hover: too few cameras deliver images: front frozen, back frozen")
            await _is_held_and_stays_so(process, fault_s, repair=lambda: _good_again(process))

    tell(story)


def _all_see(process: Process) -> bool:
    cameras = process.heard()["computer"].message["cameras"].values()
    return all(camera["fault"] is None and camera["age_s"] < NOTICED_S for camera in cameras)


def _good_again(process: Process) -> None:
    def as_it_is(frame: Frame) -> Frame:
        return frame

    process.cameras.spoil = as_it_is
