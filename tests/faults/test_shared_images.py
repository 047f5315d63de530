"""Faults of a board that sends one image of two cameras, while a whole drone flies."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from flockd.core.config import DroneConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.onboard.daemon import daemon
from flockd.onboard.sources.device_source import Devices, DeviceSource
from tests.calm import clock
from tests.faults.conftest import InTheAir, never_alone
from tests.faults.stories import Reacted
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import CAMERAS, FRAMES_HZ, HEIGHT, SECONDS_TO_FAIL, WIDTH, Watched, noise
from tests.onboard.sources.fake_kernel import FakeCamera, FakeKernel

pytestmark = pytest.mark.slow


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> FakeKernel:
    """Of the computer aboard, with the board plugged in."""
    kernel = FakeKernel(board=FakeCamera(formats=((WIDTH * len(CAMERAS), HEIGHT, b"YUYV"),), rates=(5,)))

    def opened(config: DroneConfig, file: str, *, clock: Callable[[], float]) -> DeviceSource:
        assert config.source is not None
        source = DeviceSource(dict.fromkeys(CAMERAS, (WIDTH, HEIGHT)), config.source, Devices(kernel))
        source._clock = clock
        return source

    monkeypatch.setattr(daemon, "open_source", opened)
    return kernel


def _with_a_board(config: DroneConfig) -> DroneConfig:
    cameras = tuple(
        CameraDeviceParameters(
            name=name, device="/dev/board", pixel_format="yuyv", crop=(WIDTH * k, 0, WIDTH, HEIGHT), rate_hz=5.0
        )
        for k, name in enumerate(CAMERAS)
    )
    return never_alone(config).model_copy(
        update={"source": SourceParameters(kind="v4l2", cameras=cameras, set_tolerance_s=0.1)}
    )


@contextmanager
def _sends(kernel: FakeKernel) -> Iterator[set[str]]:
    """The board sends until it is left; the set names the cameras whose part is frozen."""
    frozen, last, closing = set[str](), dict[str, int](), threading.Event()

    def run() -> None:
        number = 0
        while not closing.wait(1.0 / FRAMES_HZ):
            number += 1
            last.update({name: number for name in CAMERAS if name not in frozen})
            grey = np.concatenate([noise(name, last[name], 16)[..., 1] for name in CAMERAS], axis=1)
            image = np.stack([grey, np.full_like(grey, 128)], axis=-1)
            try:
                kernel.send("board", image.tobytes(), time_s=clock(), wait_s=0.1)
            except AssertionError:
                continue  # it is not streaming

    sending = threading.Thread(target=run, daemon=True)
    sending.start()
    try:
        yield frozen
    finally:
        closing.set()
        sending.join()


def _opened(ship: Watched) -> list[int]:
    return [camera["counts"]["opened"] for camera in ship.heard()["computer"].message["cameras"].values()]


@pytest.mark.fault("one-camera-gone", within_s=3.0)
@pytest.mark.fault("frozen-frames", within_s=3.0)
async def test_one_part_of_the_image_freezes_and_the_drone_flies_on_by_the_other(
    kernel: FakeKernel, in_the_air: InTheAir, reacted: Reacted
) -> None:
    with _sends(kernel) as frozen:
        async with in_the_air(change=_with_a_board) as ship:
            await ship.is_ready_in_the_air()
            await ship.flies()
            frozen.add("back")
            fault_s = clock()
            await ship.until_event("degraded: a camera is lost: back frozen")
            for fault in ("one-camera-gone", "frozen-frames"):
                reacted(fault, clock() - fault_s)
            await ship.steps_on(3)
            assert ship.fake_autopilot.mode == "OFFBOARD"
            frozen.clear()
            await ship.until_state("normal")


@pytest.mark.fault("camera-unplugged", within_s=4.0)
async def test_the_board_is_unplugged_and_all_its_cameras_are_lost(
    kernel: FakeKernel, in_the_air: InTheAir, reacted: Reacted
) -> None:
    with _sends(kernel):
        async with in_the_air(change=_with_a_board) as ship:
            await ship.is_ready_in_the_air()
            await ship.flies()
            kernel.unplug("board")
            fault_s = clock()
            await ship.until_event("hover: too few cameras deliver images: front ")
            await ship.until_mode()
            reacted("camera-unplugged", clock() - fault_s)
            assert not ship.fake_autopilot.failsafe
            await ship.until_state("silent")
            async with ship.sends_nothing():
                kernel.plug("board")
                await until(lambda: _opened(ship) == [2, 2], SECONDS_TO_FAIL)
            assert (await ship.ask("ask/resume"))["accepted"] is True
            await ship.until_state("ready")
