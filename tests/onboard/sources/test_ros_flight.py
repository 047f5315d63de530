"""A simulated flight whose cameras go out over ROS 2 and come in again: run with `make ros`."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.messages import FrameSet, PilotOutput
from flockd.flight.pilot import FlockPilot
from flockd.onboard.recording.reader import RecordedStep, Recording
from flockd.onboard.sources import open_source
from tests.fleet.ros.peers import ended, own_domain

pytestmark = [pytest.mark.ros, pytest.mark.slow]

FLIGHT = Path(__file__).parents[2] / "review" / "replay" / "crossing.mcap"
STEPS = 10


def through_ros(folder: Path, recording: Recording, steps: list[RecordedStep]) -> Iterator[tuple[FrameSet, float]]:
    """Each set as it arrived, with by how much its clock is ahead of the recording's."""
    names = [camera.name for camera in recording.config.rig.cameras]
    arrays: dict[str, Any] = {
        f"images_{name}": np.stack([step.frames.frames[name].image for step in steps]) for name in names
    }
    for camera in recording.config.rig.cameras:
        lens = camera.intrinsics
        arrays[f"k_{camera.name}"] = np.array([lens.fx, 0, lens.cx - 0.5, 0, lens.fy, lens.cy - 0.5, 0, 0, 1.0])
    file = folder / "flight.npz"
    np.savez(file, names=names, stamps=[step.frames.time_s for step in steps], **arrays)
    cameras = tuple(CameraDeviceParameters(name=name, topic=f"/{name}/image_raw", rate_hz=2.0) for name in names)
    parameters = SourceParameters(kind="ros", cameras=cameras, silence_s=60.0, set_tolerance_s=0.25, set_wait_s=5.0)
    source = open_source(recording.config.model_copy(update={"source": parameters}), "drone.yaml")
    source.start()
    command = [sys.executable, str(Path(__file__).with_name("ros_cameras.py")), str(file), "on request"]
    try:
        with ended(subprocess.Popen(command, stdin=subprocess.PIPE, text=True)) as driver:
            assert driver.stdin is not None
            for step in steps:
                driver.stdin.write("\n")
                driver.stdin.flush()
                frames = source.newest(60.0)
                assert frames is not None, source.status()
                yield frames, frames.time_s - step.frames.time_s
        counts = {name: status.counts for name, status in source.status().items()}
        assert all(one.get("lost", 0) == 0 and one["used"] == len(steps) for one in counts.values()), counts
    finally:
        source.stop()


def test_the_same_detections_as_without_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images bit by bit; times to what a stamp in nanoseconds and two clocks can hold; so the same detections."""
    for key, value in own_domain().items():
        monkeypatch.setenv(key, value)
    recording = Recording(FLIGHT)
    steps = list(itertools.islice(recording.steps(), STEPS))
    received = list(through_ros(tmp_path, recording, steps))
    ahead_s = np.array([ahead for _, ahead in received])
    sys.stdout.write(f"stamps against the recording's, from first to last: {1e6 * np.ptp(ahead_s):.1f} us apart\n")
    assert np.ptp(ahead_s) < 0.01, "the two clocks of this computer drift less"
    with_ros, without = FlockPilot(recording.config), FlockPilot(recording.config)
    found = 0
    for step, (frames, _) in zip(steps, received, strict=True):
        for name, frame in step.frames.frames.items():
            assert np.array_equal(frames.frames[name].image, frame.image)
        # At the recorded times: of a drone that is as sure as a threshold asks, a microsecond may decide.
        seen = {name: replace(frame, image=frames.frames[name].image) for name, frame in step.frames.frames.items()}
        one = with_ros.step(replace(step.frames, frames=seen), step.vehicle)
        other = without.step(step.frames, step.vehicle)
        same_detections(one, other)
        found += len(one.detections)
    assert found > STEPS / 2, "there was something to detect"
    sys.stdout.write(f"{found} detections in {STEPS} steps, the same with ROS 2 and without\n")


def same_detections(one: PilotOutput, other: PilotOutput) -> None:
    assert len(one.detections) == len(other.detections)
    for mine, yours in zip(one.detections, other.detections, strict=True):
        np.testing.assert_allclose(mine.bearing, yours.bearing, atol=1e-6)
        assert mine.log_range == pytest.approx(yours.log_range, abs=1e-6)
        assert mine.cameras == yours.cameras
    assert [n.track for n in one.neighbours] == [n.track for n in other.neighbours]
