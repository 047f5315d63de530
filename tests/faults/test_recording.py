"""Faults of the disk, and ends of the process, while a whole drone flies and records."""

from __future__ import annotations

import asyncio
import resource
import signal
import time
from pathlib import Path

import pytest

from flockd.onboard.recording.reader import Recording
from tests.faults.process import Process, flying
from tests.faults.stories import Reacted
from tests.onboard.autopilot.flight import until

pytestmark = pytest.mark.slow
MB = 1 << 20


def _recording(process: Process) -> Path:
    """Of this flight: one that a busy computer broke off has its own."""
    return max(process.folder.glob("tiny-2*.mcap"))


async def _has_recorded(process: Process, bytes_: int) -> Path:
    await until(lambda: _recording(process).stat().st_size > bytes_, 60.0)
    return _recording(process)


@pytest.mark.fault("sigterm", within_s=2.0)
async def test_sigterm_in_flight(tmp_path: Path, reacted: Reacted) -> None:
    async with flying(tmp_path) as process:
        path = _recording(process)
        await asyncio.sleep(2.0)
        asked_s = process.signal(signal.SIGTERM)
        await process.until_mode()
        reacted("sigterm", time.monotonic() - asked_s)
        assert not process.fake_autopilot.failsafe, "Hold was asked for"
        assert process.standing_still(asked_s + 0.3) or process.last_setpoint_s() < asked_s + 0.3
        assert await process.ended() == 0
        recording = Recording(path)
        assert recording.contents.finished
        assert len(list(recording.steps())) > 3


@pytest.mark.fault("killed-while-recording", within_s=2.0)
async def test_it_is_killed_while_it_records(tmp_path: Path, reacted: Reacted) -> None:
    """As for a loss of power: the autopilot's failsafe acts, and what was written can be read."""
    found: list[Path] = []
    async with flying(tmp_path) as process:
        found.append(await _has_recorded(process, 150_000))
        killed_s = process.signal(signal.SIGKILL)
        await process.until_mode()
        reacted("killed-while-recording", time.monotonic() - killed_s)
        assert process.fake_autopilot.failsafe, "nobody was there to ask for Hold"
    recording = Recording(found[0])
    assert not recording.contents.finished
    assert len(list(recording.steps())) > 3


@pytest.mark.fault("disk-full", within_s=5.0)
async def test_the_disk_is_full(tmp_path: Path, reacted: Reacted) -> None:
    """No file of the process may grow any more, which to it is the same as a full disk."""
    async with flying(tmp_path) as process:
        path = await _has_recorded(process, 50_000)
        size = path.stat().st_size
        full_s = time.monotonic()
        resource.prlimit(process.program.process.pid, resource.RLIMIT_FSIZE, (size, size))
        await until(lambda: any("recording" in event and "file too large" in event for event in process.events))
        reacted("disk-full", time.monotonic() - full_s)
        await process.steps_on()
        assert process.fake_autopilot.mode == "OFFBOARD"
        assert "file too large" in process.heard()["computer"].message["recording"]
