"""A simulator publishes frames; a drone's source receives them byte for byte."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh

from flockd.core.config.source import SharedMemoryParameters, SourceParameters
from flockd.core.messages import Frame, FrameSet
from flockd.onboard.sources import FramePublisher
from flockd.onboard.sources.shared_memory import SharedMemorySource
from flockd.sim.sitl.processes import free_endpoint
from tests.onboard.sources.camera_images import SIZE, scene

CAMERAS = ("front", "back")


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def source(endpoint: str) -> Iterator[SharedMemorySource]:
    """Drone 3 of a flock, waiting for its frames."""
    parameters = SourceParameters(
        kind="shared_memory", set_wait_s=5.0, shared_memory=SharedMemoryParameters(drone="3", connect=(endpoint,))
    )
    source = SharedMemorySource(dict.fromkeys(CAMERAS, SIZE), parameters)
    source.start()
    yield source
    source.stop()


def _send(publisher: FramePublisher, number: int, drone: str = "3") -> float:
    """Gives the time stamp."""
    time_s = time.monotonic()
    for offset, camera in enumerate(CAMERAS):
        publisher.publish(drone, Frame(camera, scene(2 * number + offset), time_s, number))
    return time_s


def _first(publisher: FramePublisher, source: SharedMemorySource) -> tuple[FrameSet, int]:
    """The first set that arrives, and the number after the last sent; the two find each other within a second or so."""
    for number in range(200):
        _send(publisher, number)
        frames = source.newest(0.1)
        if frames is not None and len(frames.frames) == 2:
            return frames, number + 1
    pytest.fail("nothing arrived")


def _assert_same(frames: FrameSet, number: int) -> None:
    assert frames.frames.keys() == set(CAMERAS)
    for offset, camera in enumerate(CAMERAS):
        frame = frames.frames[camera]
        assert (frame.camera, frame.time_s, frame.sequence) == (camera, frames.time_s, number)
        np.testing.assert_array_equal(frame.image, scene(2 * number + offset))


def test_frames_arrive_byte_for_byte_in_one_process(endpoint: str, source: SharedMemorySource) -> None:
    with FramePublisher(listen=[endpoint]) as publisher:
        frames, number = _first(publisher, source)
        _assert_same(frames, frames.frames["front"].sequence)
        for later in range(number, number + 10):
            time_s = _send(publisher, later)
            received = source.newest(60.0)
            assert received is not None
            assert received.time_s == time_s
            _assert_same(received, later)
        status = source.status()["front"]
        assert status.fault is None
        assert 0.0 < status.age_s < 60.0


def test_without_shared_memory_the_same_bytes_come_through_the_socket(
    endpoint: str, source: SharedMemorySource, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole_open = zenoh.open
    refusals: list[bool] = []

    def without(config: zenoh.Config) -> zenoh.Session:
        if config.get_json("transport/shared_memory/enabled") == "true":
            refusals.append(True)
            raise zenoh.ZError("Unable to create POSIX shm segment: OS error 30 at segment.rs:85.")
        return whole_open(config)

    monkeypatch.setattr(zenoh, "open", without)
    with FramePublisher(listen=[endpoint]) as publisher:
        frames, _ = _first(publisher, source)
        _assert_same(frames, frames.frames["front"].sequence)
    assert refusals == [True]


def test_a_drone_sees_its_own_frames_only(endpoint: str, source: SharedMemorySource) -> None:
    with FramePublisher(listen=[endpoint]) as publisher:
        _, number = _first(publisher, source)
        source.newest()
        before = source.status()["front"].counts["received"]
        for later in range(number, number + 5):
            _send(publisher, later, drone="4")
        assert source.newest(0.3) is None
        assert source.status()["front"].counts["received"] == before


def test_messages_that_are_no_frames_are_counted_and_ignored(endpoint: str, source: SharedMemorySource) -> None:
    header = struct.Struct("<4sHHQd")
    with FramePublisher(listen=[endpoint]) as publisher:
        _, number = _first(publisher, source)
        stranger = publisher._publisher("3", "front")
        stranger.put(b"hello")
        stranger.put(b"hello", attachment=b"hello")
        stranger.put(scene().tobytes(), attachment=header.pack(b"bgr8", 640, 480, 1, 1e6))
        wrong_size = "front: frames are 320x240, but the rig has 640x480; correct one"
        for corrupt, fault in enumerate([None, None, wrong_size]):
            stranger.put(scene()[::2, ::2].tobytes(), attachment=header.pack(b"rgb8", 320, 240, 1, 1e6))
            until_s = time.monotonic() + 5.0
            while (status := source.status()["front"]).counts.get("corrupt") != corrupt + 1:
                assert time.monotonic() < until_s
                time.sleep(0.01)
            assert status.fault == fault, "one bad frame is no lost camera"
        assert status.counts["malformed"] == 3
        stranger.put(b"too short", attachment=header.pack(b"rgb8", 640, 480, number, time.monotonic()))
        publisher.publish("3", Frame("back", scene(), time.monotonic(), number))
        frames = source.newest(60.0)
        assert frames is not None
        assert frames.frames.keys() == {"back"}


@pytest.mark.fault("time-stamps-jump")
@pytest.mark.parametrize("wrong_by_s", [3.0, 86400.0, 1e300, -86400.0, math.nan, math.inf])
def test_stamps_of_another_clock_are_dropped_and_good_frames_go_on_at_once(
    endpoint: str, source: SharedMemorySource, wrong_by_s: float
) -> None:
    with FramePublisher(listen=[endpoint]) as publisher:
        _, number = _first(publisher, source)
        while source.newest(0.1) is not None:
            pass
        for bad in range(3):
            publisher.publish("3", Frame("front", scene(), time.monotonic() + wrong_by_s, number))
            assert source.newest(0.2) is None
            status = source.status()["front"]
            assert status.counts["time_stamp"] == bad + 1
            assert (status.fault is not None) == (bad == 2), "one bad frame is no lost camera"
        assert "front: a time stamp " in str(status.fault)
        _send(publisher, number + 1)
        received = source.newest(60.0)
        assert received is not None
        _assert_same(received, number + 1)
        assert source.status()["front"].fault is None


def test_a_source_without_simulator_starts_and_stops(source: SharedMemorySource) -> None:
    assert source.newest(0.05) is None
    source.stop()
    assert source.newest(3600.0) is None, "who waits for frames is let go"
