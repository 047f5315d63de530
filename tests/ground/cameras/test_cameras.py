"""`flockd cameras` on computers with USB cameras, a Raspberry Pi's, a Jetson's, and none. All devices are fakes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.ground.cameras.listing import Computer
from flockd.ground.cameras.watching import edge_width_px
from flockd.ground.datasets.image_files import read_image
from tests.ground.filming import filming
from tests.onboard.sources.fake_kernel import METADATA_CAPTURE, STREAMING, FakeCamera, FakeKernel

Capture = pytest.CaptureFixture[str]
BY_PATH = "platform-xhci-usb-0:{port}:1.0-video-index0"
USB = FakeCamera(card=b"HD Camera", formats=((1280, 720, b"MJPG"), (640, 480, b"MJPG"), (640, 480, b"YUYV")))
MONITOR = """\
Probing devices...


Device found:

\tname  : /base/soc/i2c0mux/i2c@1/imx219@10
\tclass : Source/Video
\tcaps  : video/x-raw, format=NV12, width=1640, height=1232
\tgst-launch-1.0 libcamerasrc camera-name="/base/soc/i2c0mux/i2c\\@1/imx219\\@10" ! ...


Device found:

\tname  : HD Camera
\tclass : Video/Source
\tcaps  : image/jpeg, width=640, height=480, framerate=30/1
\tproperties:
\t\tdevice.path = /dev/video0
\tgst-launch-1.0 v4l2src ! ...
"""
SENSOR = FakeCamera(card=b"unicam", formats=((1640, 1232, b"RG10"),))


def _link(port: int) -> str:
    """By which a camera's socket is known."""
    return f"/dev/v4l/by-path/{BY_PATH.format(port=port)}"


Shelf = Callable[..., FakeKernel]


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Shelf:
    """Puts cameras into the computer that the command looks at; what programs print by their names, else they fail."""
    nodes, links = tmp_path / "computer" / "nodes", tmp_path / "computer" / "links"

    def has(kernel: FakeKernel, **printed: str) -> FakeKernel:
        for path in (nodes, links):
            path.mkdir(parents=True)
        for port, (device, camera) in enumerate(list(kernel.cameras.items())):
            name = Path(device).name
            kernel.cameras[_link(port)] = camera
            (nodes / name).mkdir()
            (links / BY_PATH.format(port=port)).symlink_to(f"../../{name}")
            (links / BY_PATH.format(port=port).replace("usb-", "usbv2-")).symlink_to(f"../../{name}")
        made = Computer(kernel, nodes, links, lambda command: printed.get(command[0][:-4].replace("-", "_")))
        monkeypatch.setattr("flockd.ground.cameras.listing.Computer", lambda: made)
        return kernel

    return has


def test_usb_cameras_are_listed_by_the_path_of_their_socket(computer: Shelf, capsys: Capture) -> None:
    metadata = FakeCamera(capabilities=METADATA_CAPTURE | STREAMING)
    kernel = computer(FakeKernel(video0=USB, video1=metadata, video10=USB))
    assert main(["cameras", "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)
    assert (first["node"], first["device"]) == ("/dev/video0", _link(0))
    assert (second["node"], second["device"]) == ("/dev/video10", _link(2))
    assert first["name"] == "HD Camera"
    assert first["modes"] == [
        {"pixel_format": "mjpeg", "size_px": [1280, 720], "rates_hz": [30.0, 15.0]},
        {"pixel_format": "mjpeg", "size_px": [640, 480], "rates_hz": [30.0, 15.0]},
        {"pixel_format": "yuyv", "size_px": [640, 480], "rates_hz": [30.0, 15.0]},
    ]
    assert first["used"] == {"pixel_format": "mjpeg", "size_px": [640, 480], "rates_hz": [30.0]}
    assert first["controls"]["exposure_time_absolute"] == [1, 5000]
    assert not kernel.open_files, "all are given back"
    assert main(["cameras", "--size", "1280x720"]) == 0
    shown, _ = yaml.safe_load(capsys.readouterr().out)
    assert (shown["name"], shown["device"]) == ("HD Camera", _link(0))
    assert shown["modes"] == {"mjpeg": "1280x720 at 30, 15; 640x480 at 30, 15", "yuyv": "640x480 at 30, 15"}
    assert shown["used"] == "mjpeg 1280x720 at 30"


def test_all_are_measured_side_by_side_and_pictured(computer: Shelf, capsys: Capture, tmp_path: Path) -> None:
    kernel = computer(FakeKernel(video0=FakeCamera(), video1=FakeCamera(), video2=FakeCamera()))
    begun_s = time.monotonic()
    with filming(kernel, "video0", "video1"):  # the third is silent
        assert main(["cameras", "--seconds", "0.5", "--picture", str(tmp_path / "pictures"), "--json"]) == 1
    first, second, third = json.loads(capsys.readouterr().out)
    assert time.monotonic() - begun_s > 0.5
    for row in (first, second):
        assert row["measured"]["fault"] is None
        assert row["measured"]["rate_hz"] > 0.0
        image = read_image(Path(row["picture"]))
        assert image[240, 100, 0] > 200
        assert image[240, 600, 0] < 100
        assert row["measured"]["mean_grey"] == pytest.approx(image.mean(), abs=0.1)
    assert third["picture"] is None
    assert "gave no usable image for 3 s; try another cable" in third["measured"]["fault"]


def test_what_is_written_checks_and_names_the_devices(computer: Shelf, capsys: Capture, tmp_path: Path) -> None:
    computer(FakeKernel(video0=USB, video2=FakeCamera(rates=(15, 5))))
    file = tmp_path / "cameras.yaml"
    assert main(["cameras", "--write", str(file)]) == 0
    config = load_drone(file)
    assert main(["config", "check", str(file)]) == 0
    assert config.source is not None
    assert [camera.name for camera in config.rig.cameras] == ["front", "back"]
    assert [camera.size_px for camera in config.rig.cameras] == [(640, 480), (640, 480)]
    assert [camera.extrinsics.yaw_deg for camera in config.rig.cameras] == [0.0, 180.0]
    assert [(camera.device, camera.rate_hz) for camera in config.source.cameras] == [
        (_link(0), 30.0),
        (_link(1), 15.0),
    ]
    assert {control.name: control.value for control in config.source.cameras[0].controls} == {
        "auto_exposure": 1,
        "exposure_time_absolute": 50,
    }
    assert "gain 0 to 255" in file.read_text(encoding="utf-8")
    assert main(["cameras", "--write", str(file)]) == 2, "it exists"
    assert main(["cameras", "--write", str(file), "--force", "--names", "left", "left"]) == 2
    assert main(["cameras", "--write", str(file), "--force", "--names", "left", "right", "--turn-deg", "90"]) == 0
    config = load_drone(file)
    assert config.source is not None
    assert [camera.name for camera in config.rig.cameras] == ["left", "right"]
    assert (config.rig.cameras[0].size_px, config.source.cameras[0].turn_deg) == ((480, 640), 90), "upright"
    # 320 px at 65 degrees of an equidistant lens: r = f theta.
    assert config.rig.cameras[0].intrinsics.fy == pytest.approx(320 / 1.1344640, abs=0.05)


def test_a_raspberry_pis_camera_becomes_a_pipeline(computer: Shelf, tmp_path: Path, capsys: Capture) -> None:
    """Its sensor is a V4L2 device too, which gives raw values only; the USB camera beside it goes through GStreamer."""
    computer(FakeKernel(video0=SENSOR, video1=USB), gst_device_monitor=MONITOR)
    file = tmp_path / "cameras.yaml"
    assert main(["cameras", "--write", str(file), "--turn-deg", "90"]) == 2
    assert "add `videoflip`" in capsys.readouterr().err
    assert main(["cameras", "--write", str(file)]) == 0
    config = load_drone(file)
    assert config.source is not None
    assert config.source.kind == "gstreamer"
    assert [camera.pipeline for camera in config.source.cameras] == [
        f"v4l2src device={_link(1)} ! image/jpeg,width=640,height=480,framerate=30/1",
        'libcamerasrc camera-name="/base/soc/i2c0mux/i2c\\@1/imx219\\@10" '
        "! video/x-raw,format=NV12,width=640,height=480,framerate=30/1",
    ]


def test_a_jetsons_sensors_are_nvidias_cameras_in_the_kernels_order(computer: Shelf, capsys: Capture) -> None:
    computer(FakeKernel(video0=SENSOR, video1=USB, video2=SENSOR), gst_inspect="anything")
    assert main(["cameras", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(one["node"], one["element"]) for one in found] == [
        ("/dev/video0", "nvarguscamerasrc sensor-id=0"),
        ("/dev/video1", None),
        ("/dev/video2", "nvarguscamerasrc sensor-id=1"),
    ]


def test_a_computer_without_cameras_gets_one_sentence(computer: Shelf, capsys: Capture, tmp_path: Path) -> None:
    computer(FakeKernel())
    assert main(["cameras", "--write", str(tmp_path / "cameras.yaml")]) == 69
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "cameras.yaml").exists()


def test_a_camera_that_cannot_be_used_says_why(computer: Shelf, capsys: Capture) -> None:
    kernel = computer(FakeKernel(video0=SENSOR, video1=FakeCamera(formats=((640, 480, b"H264"),)), video2=USB))
    kernel.cameras["/dev/video2"] = FakeCamera(plugged=False)
    assert main(["cameras"]) == 1
    told = "".join(camera["fault"] for camera in yaml.safe_load(capsys.readouterr().out))
    for fault in ("sends a sensor's raw values only; read it by", "offers H264, and flockd reads", "cannot be opened"):
        assert fault in told


@pytest.mark.parametrize("blur_px", [2.0, 3.0, 4.0])
def test_the_width_of_edges_is_two_and_a_half_deviations_of_the_blur(blur_px: float) -> None:
    """A step blurred by a Gaussian has the slope contrast / (s sqrt(2 pi)) in its middle: sqrt(2 pi) = 2.507."""
    image = np.full((240, 320, 3), 40, np.uint8)
    assert np.isnan(edge_width_px(image)), "nothing has an edge"
    image[60:180, 100:220] = 200
    assert edge_width_px(image) < 3.0
    blurred = cv2.GaussianBlur(image, (0, 0), blur_px)
    assert edge_width_px(np.asarray(blurred, np.uint8)) == pytest.approx(2.507 * blur_px, rel=0.15)
