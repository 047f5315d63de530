"""Boards for several cameras send one image of all: one device, pipeline or topic, of which each camera has a part."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.source import CameraDeviceParameters
from flockd.core.errors import ConfigError
from flockd.core.messages import FrameSet, UInt8Array
from flockd.flight.pilot import FlockPilot
from flockd.ground.calibration.image_sources import from_camera
from flockd.onboard.message_json import to_json
from flockd.onboard.recording.reader import Recording
from flockd.onboard.sources.device_source import Devices
from tests.onboard.sources.camera_images import jpeg, scene
from tests.onboard.sources.fake_kernel import FakeCamera, FakeKernel
from tests.onboard.sources.test_gstreamer import FAKE
from tests.onboard.sources.test_ros_topics import RGB, image
from tests.onboard.sources.watched import Watch, WatchedSource

FLIGHT = Path(__file__).parents[2] / "review" / "replay" / "crossing.mcap"
PARTS = {"front": (0, 0), "right": (240, 0), "back": (0, 320), "left": (240, 320)}
"""Where each camera of the recorded flight stands in an image of 480 x 640."""
PART, WHOLE = (240, 320), (480, 640)


def _yuyv(rgb: UInt8Array) -> UInt8Array:
    """(h, w, 2): as a camera sends it, by BT.601 with colours of every other pixel."""
    r, g, b = np.moveaxis(rgb.astype(float), -1, 0)
    y = 16 + (65.738 * r + 129.057 * g + 25.064 * b) / 256
    u, v = 128 + (-37.945 * r - 74.494 * g + 112.439 * b) / 256, 128 + (112.439 * r - 94.154 * g - 18.285 * b) / 256
    colours = np.stack([u[:, ::2], v[:, ::2]], axis=-1).reshape(rgb.shape[:2])
    return np.stack([y, colours], axis=-1).round().astype(np.uint8)


def _cameras(**changes: Any) -> tuple[CameraDeviceParameters, ...]:
    fields = {"device": "/dev/board", "pixel_format": "yuyv", **changes}
    return tuple(
        CameraDeviceParameters.model_validate({"name": name, "crop": (*corner, *PART), **fields}, strict=False)
        for name, corner in PARTS.items()
    )


def _board(watch: Watch, code: bytes = b"YUYV", **changes: Any) -> tuple[FakeKernel, WatchedSource]:
    kernel = FakeKernel(board=FakeCamera(formats=((*WHOLE, code),)))
    return kernel, watch(dict.fromkeys(PARTS, PART), _cameras(**changes), Devices(kernel))


def _side_by_side(parts: Mapping[str, Any]) -> Any:
    rows = ("front", "right"), ("back", "left")
    return np.concatenate([np.concatenate([parts[name] for name in row], axis=1) for row in rows])


def _noise(seed: int) -> dict[str, UInt8Array]:
    rng = np.random.default_rng(seed)
    return {name: rng.integers(0, 256, (*PART[::-1], 3), dtype=np.uint8) for name in PARTS}


def _flown(config: DroneConfig, sets: list[FrameSet], recording: Recording) -> list[object]:
    pilot = FlockPilot(config)
    outputs = [
        pilot.step(frames, replace(step.vehicle, time_s=frames.time_s))
        for frames, step in zip(sets, recording.steps(), strict=False)
    ]
    return [to_json(replace(output, stages_ms={})) for output in outputs]


def test_four_parts_of_one_image_fly_as_four_cameras_do(watch: Watch) -> None:
    """A recorded flight of four cameras: as four devices, and as one that sends them side by side."""
    recording = Recording(FLIGHT)
    views = [
        {name: _yuyv(frame.image) for name, frame in step.frames.frames.items()}
        for _, step in zip(range(4), recording.steps(), strict=False)
    ]
    apart = FakeKernel(**{name: FakeCamera(formats=((*PART, b"YUYV"),)) for name in PARTS})
    alone = tuple(CameraDeviceParameters(name=name, device=f"/dev/{name}", pixel_format="yuyv") for name in PARTS)
    four = watch(dict.fromkeys(PARTS, PART), alone, Devices(apart))
    together, one = _board(watch)
    began_s = time.monotonic() - 0.5 * len(views)
    of_four, of_one = list[FrameSet](), list[FrameSet]()
    for number, parts in enumerate(views):
        for name, part in parts.items():
            apart.send(name, part.tobytes(), time_s=began_s + 0.5 * number)
        together.send("board", _side_by_side(parts).tobytes(), time_s=began_s + 0.5 * number)
        count = dict.fromkeys(PARTS, number + 1)
        four.received(**count)
        one.received(**count)
        of_four.append(four.next())
        of_one.append(one.next())
    for left, right in zip(of_four, of_one, strict=True):
        assert left.time_s == right.time_s
        assert left.frames.keys() == right.frames.keys() == PARTS.keys()
        for name in PARTS:
            a, b = left.frames[name], right.frames[name]
            assert np.array_equal(a.image, b.image)
            assert (a.time_s, a.sequence) == (b.time_s, b.sequence)
    assert len(together.open_files) == 1, "the device is opened once"
    assert together.cameras["/dev/board"].settings[0] == ("format", (*WHOLE, b"YUYV"))
    first, second = (_flown(recording.config, sets, recording) for sets in (of_four, of_one))
    assert first == second
    assert any(output["detections"] for output in first), "and they see something"  # type: ignore[index]


def test_a_jpeg_of_all_is_decoded_once(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel, source = _board(watch, b"MJPG", pixel_format="mjpeg")
    decode = Mock(wraps=cv2.imdecode)
    monkeypatch.setattr(cv2, "imdecode", decode)
    whole = cv2.GaussianBlur(_side_by_side(_noise(1)), (0, 0), 4)
    kernel.send("board", jpeg(whole))
    frames = source.next().frames
    assert decode.call_count == 1
    for name, (left, top) in PARTS.items():
        sent = whole[top : top + 320, left : left + 240]
        assert np.abs(frames[name].image.astype(int) - sent).mean() < 4.0, name


@pytest.mark.parametrize(("turn_deg", "quarters"), [(90, -1), (180, 2), (270, 1)])
def test_each_part_is_turned_and_reduced(watch: Watch, turn_deg: Any, quarters: int) -> None:
    """A board whose cameras lie on their sides, in images of twice the size; the second one is as it is."""
    lying = _cameras(reduce=2)[0].model_copy(update={"turn_deg": turn_deg})
    sizes = {"front": (120, 160) if turn_deg == 180 else (160, 120), "right": (120, 160)}
    kernel = FakeKernel(board=FakeCamera(formats=((480, 320, b"YUYV"),)))
    source = watch(sizes, (lying, _cameras(reduce=2)[1]), Devices(kernel))
    red_above = np.concatenate([np.full((160, 480, 3), (220, 40, 40)), np.full((160, 480, 3), (40, 40, 220))])
    red_above = (red_above + np.random.default_rng(2).integers(0, 30, (320, 480, 1))).astype(np.uint8)
    kernel.send("board", _yuyv(red_above).tobytes())
    frames = source.next().frames
    expected = np.rot90(cv2.resize(red_above[:, :240], (120, 160), interpolation=cv2.INTER_AREA), quarters)
    assert frames["front"].image.shape == expected.shape
    assert np.abs(frames["front"].image.astype(int) - expected).mean() < 6.0
    upright = cv2.resize(red_above[:, 240:], (120, 160), interpolation=cv2.INTER_AREA)
    assert np.abs(frames["right"].image.astype(int) - upright).mean() < 6.0


@pytest.mark.fault("frozen-frames")
@pytest.mark.parametrize(("code", "pixel_format"), [(b"YUYV", "yuyv"), (b"MJPG", "mjpeg")])
def test_a_part_that_freezes_while_the_others_go_on_is_noticed(watch: Watch, code: bytes, pixel_format: str) -> None:
    """One sensor of a board hangs: the images of all still differ. Five repetitions, as of any camera.

    Colours of a JPEG are smoothed across the border of two parts.
    """
    kernel, source = _board(watch, code, pixel_format=pixel_format)

    def send(parts: Mapping[str, UInt8Array]) -> None:
        whole = _side_by_side(parts)
        kernel.send("board", jpeg(whole) if code == b"MJPG" else _yuyv(whole).tobytes())

    for number in range(7):
        send(_noise(number) | {"left": _noise(0)["left"]})
        there = source.next().frames.keys()
        assert there == (PARTS.keys() if number < 5 else PARTS.keys() - {"left"}), number
    status = source.status()
    assert status["left"].fault == "left: the image is frozen; restart its camera or program"
    assert status["left"].counts["frozen"] == 2
    assert {status[name].fault for name in PARTS if name != "left"} == {None}


@pytest.mark.fault("damaged-images")
def test_a_part_that_shows_nothing_costs_that_camera_alone(watch: Watch) -> None:
    """Both lower lenses covered: as an image that stops short, the whole was refused."""
    kernel, source = _board(watch)
    for number in range(3):
        parts = _noise(number) | dict.fromkeys(("back", "left"), np.full((320, 240, 3), 60 + number, np.uint8))
        kernel.send("board", _yuyv(_side_by_side(parts)).tobytes())
        assert source.next().frames.keys() == {"front", "right"}
    assert source.status()["back"].fault == "back: its images show nothing; check its lens and cable"
    assert source.status()["front"].fault is None


@pytest.mark.fault("camera-unplugged")
def test_a_board_that_is_pulled_out_is_a_fault_of_each_of_its_cameras(watch: Watch) -> None:
    kernel, source = _board(watch)
    kernel.send("board", _yuyv(_side_by_side(_noise(0))).tobytes())
    assert source.next().frames.keys() == PARTS.keys()
    kernel.unplug("board")
    for name in PARTS:
        fault = source.until(lambda status: status.fault is not None, name).fault
        assert fault == f"{name}: /dev/board is not there; plug the camera in, or correct the path"


def test_an_image_of_another_size_than_the_crops_are_of_is_refused(watch: Watch) -> None:
    kernel = FakeKernel(board=FakeCamera(formats=((640, 480, b"YUYV"),)))
    source = watch(dict.fromkeys(PARTS, PART), _cameras(), Devices(kernel))
    assert "/dev/board offers 640x480 YUYV instead of 480x640 yuyv; choose" in source.why()
    assert source.why().endswith("or correct crop_of")


HALVES = {"left": (0, 0, 32, 48), "right": (32, 0, 32, 48)}


def _halves(**fields: Any) -> tuple[CameraDeviceParameters, ...]:
    return tuple(CameraDeviceParameters(name=n, crop=crop, rate_hz=50.0, **fields) for n, crop in HALVES.items())


def test_a_pipeline_and_a_topic_are_cut_likewise(watch: Watch, tmp_path: Path) -> None:
    sizes = dict.fromkeys(HALVES, (32, 48))
    frames = watch(sizes, _halves(pipeline="caps:64x48 500 stall"), Devices(command=FAKE)).next().frames
    assert [tuple(frames[name].image[1, 10]) for name in HALVES] == [(30, 10, 245), (126, 42, 213)]
    told = watch(sizes, _halves(pipeline="caps:32x48 stall"), Devices(command=FAKE)).why()
    assert "its pipeline gives 32x48, but its crop is of 64x48; end it with" in told
    assert told.endswith("or correct crop_of")

    file = tmp_path / "messages"
    topics = Devices(ros_command=(*FAKE, str(file)))
    file.write_text(json.dumps({"kind": "imag", "data": image().hex()}), encoding="ascii")
    frames = watch(sizes, _halves(topic="/all/image_raw"), topics).next().frames
    assert np.array_equal(np.concatenate([frames[name].image for name in HALVES], axis=1), RGB)
    frames = watch(sizes, _halves(topic="/all/image_raw", turn_deg=180), topics).next().frames
    assert np.array_equal(frames["left"].image, np.rot90(RGB[:, :32], 2)), "a driver could turn the whole only"
    file.write_text(json.dumps({"kind": "imag", "data": image(width=32).hex()}), encoding="ascii")
    told = watch(sizes, _halves(topic="/all/image_raw"), topics).why()
    assert told == "left: /all/image_raw gives 32x48, but its crop is of 64x48; correct crop_of, or the driver"


RIG = """\
rig:
  cameras:
    - {name: front, size_px: [640, 480], intrinsics: {fx: 320, fy: 320, cx: 320, cy: 240}}
    - {name: back, size_px: [480, 640], intrinsics: {fx: 320, fy: 320, cx: 240, cy: 320}}
source:
  kind: v4l2
  cameras:
"""
FRONT = "    - {name: front, device: /dev/video0, crop: [0, 0, 640, 480]}\n"
BACK = "    - {name: back, device: /dev/video0, crop: [640, 0, 640, 480], turn_deg: 90}\n"


def _loaded(folder: Path, cameras: str) -> DroneConfig:
    path = folder / "drone.yaml"
    path.write_text(RIG + cameras, encoding="utf-8")
    return load_drone(path)


def test_one_camera_of_a_board_is_calibrated_on_its_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others are not run, yet the image is as large as with them."""
    config = _loaded(tmp_path, FRONT + BACK)
    assert config.source is not None
    assert config.source.whole_px(config.source.cameras[0]) == (1280, 480)
    kernel = FakeKernel(video0=FakeCamera(formats=((1280, 480, b"MJPG"),)))
    monkeypatch.setattr("flockd.onboard.sources.Devices", lambda lenses: Devices(kernel, lenses=lenses))
    stream = from_camera(config, "drone.yaml", "front", lambda: False)
    assert stream.identity == "/dev/video0"
    sent = np.concatenate([scene(1), scene(2)], axis=1)
    threading.Thread(target=kernel.send, args=("video0", jpeg(sent)), daemon=True).start()
    with closing(stream.images) as images:  # type: ignore[type-var]
        _, shown = next(images)
    assert shown.shape == (480, 640, 3)
    assert np.abs(shown.astype(int) - scene(1)).mean() < 3.0


@pytest.mark.parametrize(
    ("cameras", "problem"),
    [
        (
            FRONT + BACK.replace("crop: [640, 0, 640, 480], ", ""),
            "9: source.cameras[1].device: two cameras share /dev/video0; give each its own device, or each its `crop`",
        ),
        (FRONT + BACK.replace("[640", "[600"), "9: source.cameras[1].crop: [600, 0, 640, 480] overlaps that of camera"),
        (
            FRONT + BACK.replace(", turn_deg: 90", ""),
            "9: source.cameras[1].crop: gives images of 640 x 480, but ",
        ),
        (
            FRONT.replace("}", ", crop_of: [1280, 480]}") + BACK.replace("}", ", crop_of: [1280, 720]}"),
            "9: source.cameras[1].crop_of: differs from that of camera front, which is cut from the same image; write",
        ),
        (FRONT + BACK.replace("}", ", pixel_format: yuyv}"), "9: source.cameras[1].pixel_format: differs from that"),
        (
            FRONT.replace("}", ", crop_of: [600, 480]}") + BACK.replace("video0", "video2"),
            "8: source.cameras[0].crop: [0, 0, 640, 480] ends outside 600 x 480 of the image; correct it, or crop_of",
        ),
        (
            FRONT.replace("crop: [0, 0, 640, 480]", "crop_of: [640, 480]") + BACK.replace("video0", "video2"),
            "8: source.cameras[0].crop_of: is of a `crop`, and there is none; add it, or delete this",
        ),
        (
            FRONT.replace("[0, 0, 640, 480]", "[1, 0, 1280, 960], reduce: 2") + BACK.replace("video0", "video2"),
            "8: source.cameras[0].crop: [1, 0, 1280, 960] and its image are no multiples of reduce 2; correct one",
        ),
        (FRONT.replace("[0,", "[-1,") + BACK, "8: source.cameras[0].crop[0]: "),
        (FRONT.replace("480]", "0]") + BACK, "8: source.cameras[0].crop[3]: "),
    ],
    ids=["no crop", "overlap", "size", "whole", "format", "outside", "of nothing", "reduce", "negative", "empty"],
)
def test_crops_that_cannot_be_are_refused_with_line_and_key(tmp_path: Path, cameras: str, problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        _loaded(tmp_path, cameras)
    (told,) = str(caught.value).removeprefix(f"{tmp_path}/").splitlines()
    assert told.startswith(f"drone.yaml:{problem}")
