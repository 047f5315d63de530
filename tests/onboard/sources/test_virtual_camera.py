"""The real kernel: runs where the `vivid` virtual camera is loaded (`modprobe vivid`), and skips where it is not."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.onboard.sources.device_source import DeviceSource

RATE_HZ = 25.0


def _vivid() -> str | None:
    names = sorted(Path("/sys/class/video4linux").glob("video*/name"))
    capturing = [name for name in names if name.read_text().startswith("vivid") and "vid-cap" in name.read_text()]
    return f"/dev/{capturing[0].parent.name}" if capturing else None


def test_the_virtual_camera_streams_without_gaps_at_its_rate() -> None:
    device = _vivid()
    if device is None:
        pytest.skip("no virtual camera: `modprobe vivid` needs a kernel that has it")
    camera = CameraDeviceParameters(name="front", device=device, pixel_format="yuyv", rate_hz=RATE_HZ)
    parameters = SourceParameters(kind="v4l2", cameras=(camera,), frozen_after=0)
    source = DeviceSource({"front": (640, 480)}, parameters)
    source.start()
    try:
        frames = [source.newest(2.0) for _ in range(50)]
        times = np.array([one.time_s for one in frames if one is not None])
        assert len(times) == 50, source.status()["front"]
        assert np.median(np.diff(times)) == pytest.approx(1 / RATE_HZ, rel=0.05)
        assert source.status()["front"].counts.get("lost", 0) == 0
        assert 0.0 <= time.monotonic() - times[-1] < 0.5, "the kernel's stamps are of our clock"
    finally:
        source.stop()
