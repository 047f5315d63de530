"""H.264: what comes out of the stream, beside what FFmpeg's decoder, which OpenCV brings, makes of the same bytes."""

from __future__ import annotations

import ctypes.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.core.config.imperfect_cameras import CamerasConfig
from flockd.core.errors import UnavailableError
from flockd.core.messages import UInt8Array
from flockd.sim.real_cameras import h264
from tests.sim.real_cameras.test_scenario_cameras import flown_frames, images, scenario_with

SIZE = (320, 240)


@pytest.fixture(name="library")
def _library() -> None:
    if ctypes.util.find_library("openh264") is None:
        pytest.skip("openh264 is not here")


def _scene(step: int) -> UInt8Array:
    """Smooth shapes that move by 4 px a step, and noise of two grey levels."""
    rng = np.random.default_rng(step)
    x, y = np.meshgrid(np.arange(SIZE[0]) - 4 * step, np.arange(SIZE[1]))
    grey = 120 + 50 * np.sin(x / 17) * np.cos(y / 23) + 40 * ((x // 40 + y // 40) % 2) + rng.normal(0, 2, x.shape)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def _rms(one: UInt8Array, other: UInt8Array) -> float:
    return float(np.sqrt(np.mean((one.astype(np.float64) - other) ** 2)))


@pytest.mark.usefixtures("library")
def test_another_decoder_sees_the_same(tmp_path: Path) -> None:
    stream, shown, packed = h264.H264Stream(SIZE, 2.0), [], b""
    for step in range(6):
        image, data = stream.passed(_scene(step))
        shown.append(image)
        packed += data
    file = tmp_path / "stream.h264"
    file.write_bytes(packed)
    peer = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG)
    for step, image in enumerate(shown):
        seen = np.asarray(cv2.cvtColor(peer.read()[1], cv2.COLOR_BGR2RGB), np.uint8)
        assert _rms(seen, image) < 1.5, step  # FFmpeg rounds colours otherwise
        assert _rms(seen, _scene(step)) < 20.0, step


@pytest.mark.usefixtures("library")
def test_fewer_bits_show_less_and_an_image_is_predicted_from_the_last() -> None:
    errors = []
    for mbit_s in (0.1, 4.0):
        stream = h264.H264Stream(SIZE, mbit_s)
        sizes = [len(stream.passed(_scene(step))[1]) for step in range(8)]
        errors.append(_rms(stream.passed(_scene(8))[0], _scene(8)))
        assert sizes[1] < sizes[0] / 2
    assert errors[0] > 1.5 * errors[1]


@pytest.mark.usefixtures("library")
def test_a_scenario_s_cameras_send_a_stream_in_place_of_jpeg_the_same_each_time() -> None:
    compression = {"jpeg_quality": 1, "h264_mbit_s": 8.0}
    streamed = scenario_with(CamerasConfig.model_validate({"compression": compression}))
    first, again, ideal = (flown_frames(one) for one in (streamed, streamed, scenario_with(CamerasConfig())))
    assert images(first) == images(again)
    for step, frames in enumerate(ideal):
        for name, frame in frames.items():
            assert 0.5 < _rms(first[step][name].image, frame.image) < 8.0  # a JPEG of that quality: 15 and more


def test_odd_sides_are_refused() -> None:
    with pytest.raises(UnavailableError, match="321 x 240 have odd sides"):
        h264.H264Stream((321, 240), 1.0)


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    h264._library.cache_clear()
    try:
        with pytest.raises(UnavailableError, match=r"h264_mbit_s` needs the library openh264.*libopenh264-7"):
            h264.H264Stream(SIZE, 1.0)
    finally:
        h264._library.cache_clear()
