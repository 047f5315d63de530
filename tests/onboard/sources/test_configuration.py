"""What a person writes about cameras is checked, and becomes the source that it asks for."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.errors import ConfigError
from flockd.onboard.sources import open_source
from flockd.onboard.sources.device_source import DeviceSource
from flockd.onboard.sources.shared_memory import SharedMemorySource

QUADROTOR = Path(__file__).parents[3] / "config" / "quadrotor.yaml"
RIG = """\
rig:
  cameras:
    - {name: front, size_px: [640, 480], intrinsics: {fx: 320, fy: 320, cx: 320, cy: 240}}
    - {name: back, size_px: [640, 480], intrinsics: {fx: 320, fy: 320, cx: 320, cy: 240}}
"""
TWO = """\
  cameras:
    - {name: front, device: /dev/video0}
    - {name: back, device: /dev/video2}
"""
PIPELINES = """\
  cameras:
    - {name: front, pipeline: nvarguscamerasrc sensor-id=0}
    - {name: back, pipeline: libcamerasrc}
"""


def _problems(folder: Path, source: str) -> list[str]:
    path = folder / "drone.yaml"
    path.write_text(RIG + source, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_drone(path)
    return [line.removeprefix(f"{folder}/") for line in str(caught.value).splitlines()]


TOPICS = """\
  cameras:
    - {name: front, topic: /front/image_raw}
    - {name: back, topic: /back/image_raw/compressed, camera_info: /back/info, stamps: simulator}
"""


@pytest.mark.parametrize(
    ("source", "places"),
    [
        ("{kind: shared_memory, shared_memory: {drone: '3'}}\n", []),
        ("\n  kind: v4l2\n" + TWO, ["/dev/video0", "/dev/video2"]),
        ("\n  kind: gstreamer\n" + PIPELINES, ["nvarguscamerasrc sensor-id=0", "libcamerasrc"]),
        ("\n  kind: ros\n" + TOPICS, ["/front/image_raw", "/back/image_raw/compressed"]),
    ],
)
def test_frames_come_from_where_the_file_says_and_so_does_its_recording(
    tmp_path: Path, source: str, places: list[str]
) -> None:
    """A recording holds every key, those too that are of another kind of source and empty."""
    path = tmp_path / "drone.yaml"
    path.write_text(RIG + "source: " + source, encoding="utf-8")
    config = load_drone(path)
    assert config.source is not None
    assert [camera.place for camera in config.source.cameras] == places
    assert isinstance(open_source(config, str(path)), DeviceSource if places else SharedMemorySource)
    assert config.source.shared_memory.connect == ("tcp/127.0.0.1:7448",)
    assert DroneConfig.model_validate_json(config.model_dump_json()) == config


def test_the_examples_of_the_documentation_check(tmp_path: Path) -> None:
    """Pipelines and topics on the page of cameras, and the drone of the page on ROS 2."""
    docs = QUADROTOR.parents[1] / "docs"
    page = (docs / "cameras.md").read_text(encoding="utf-8")
    examples = re.findall(r"```yaml\n(source:.*?)```", page, re.DOTALL)
    path, places = tmp_path / "drone.yaml", []
    for example in examples:
        names = re.findall(r"\bname: (\w+)", example)
        rig = "".join(RIG.splitlines(keepends=True)[:2]) + "".join(
            RIG.splitlines(keepends=True)[2].replace("front", name) for name in names
        )
        path.write_text(rig + example, encoding="utf-8")
        source = load_drone(path).source
        assert source is not None
        places.append([camera.place.split()[0] for camera in source.cameras])
    assert places == [
        ["nvarguscamerasrc", "libcamerasrc", "rtspsrc"],
        ["/front/image_raw", "/back/image_raw/compressed"],
    ]
    (board,) = (one for one in re.findall(r"```yaml\n(rig:.*?)```", page, re.DOTALL) if "crop:" in one)
    path.write_text(board, encoding="utf-8")
    shared = load_drone(path).source
    assert shared is not None
    assert shared.whole_px(shared.cameras[0]) == (1280, 400), "as the page says"
    (eyes,) = re.findall(r"```yaml\n(.*?)```", (docs / "ros.md").read_text(encoding="utf-8"), re.DOTALL)
    path.write_text(eyes, encoding="utf-8")
    assert load_drone(path).name == "uav1"


def test_a_drone_without_source_can_be_simulated_but_opens_none(tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text(RIG, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        open_source(load_drone(path), "drone.yaml")
    assert str(caught.value).startswith("drone.yaml: source: is missing; ")


SWAPPED = PIPELINES.replace("back, pipeline", "back, device").replace("lib", "/dev/")


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("v4l2\n", "5: source.cameras: is not given, and by default has no entry of the name front, which"),
        ("v4l2\n" + TWO.replace("back", "rear"), "9: source.cameras[1].name: rear is no camera of the rig; write one"),
        ("v4l2\n" + TWO.replace("back", "front"), "9: source.cameras[1].name: front has an entry already; keep one"),
        ("v4l2\n" + TWO.replace("video2", "video0"), "9: source.cameras[1].device: two cameras share /dev/video0"),
        ("shared_memory\n" + TWO, "5: source: a source of kind `shared_memory` has no devices; delete `cameras`"),
        ("v4l2\n" + TWO.replace("device: /dev/video2", "rate_hz: 20"), "9: source.cameras[1]: has no `device`; write"),
        ("v4l2\n" + SWAPPED, "8: source.cameras[0].pipeline: is of a source of kind `gstreamer`; delete it, or write "),
        ("ros\n" + TOPICS.replace("topic: /front/image_raw", "rate_hz: 20"), "8: source.cameras[0]: has no `topic`; "),
        (
            "gstreamer\n" + PIPELINES.replace("libcamerasrc", "x, pixel_format: yuyv"),
            "9: source.cameras[1].pixel_format",
        ),
        (
            "gstreamer\n" + PIPELINES.replace("pipeline: libcamerasrc", "rate_hz: 20"),
            "9: source.cameras[1]: has no `pip",
        ),
        (
            "gstreamer\n" + PIPELINES.replace("libcamerasrc", "nvarguscamerasrc sensor-id=0"),
            "9: source.cameras[1].pipeline: two cameras share nvarguscamerasrc sensor-id=0; give each its own pipeline",
        ),
        ("v4l2\n  set_tolerance_s: 20.0\n" + TWO, "7: source.set_tolerance_s: 20 s is longer than step_s 0.5; write "),
        (
            "ros\n" + TOPICS.replace("topic: /front", "topic: front"),
            "8: source.cameras[0].topic: front/image_raw is not a whole name",
        ),
        *(
            ("gstreamer\n" + PIPELINES.replace("libcamerasrc", wrong), f"9: source.cameras[1].pipeline: {told}; ")
            for wrong, told in (
                ("libcamerasrc ! autovideosink", "ends with autovideosink, and flockd adds its own sink"),
                ("gst-launch-1.0 libcamerasrc", "begins with gst-launch-1.0"),
                ("libcamerasrc !", "has an element without a name"),
            )
        ),
        ("v4l2\n  set_tolerance_s: 0.01\n" + TWO, "7: source.set_tolerance_s: 0.01 is less than half a frame period "),
        (
            "v4l2\n  silence_s: 0.05\n" + TWO,
            "7: source.silence_s: 0.05 is less than two frame periods of camera 'front'",
        ),
    ],
)
def test_what_does_not_fit_together_is_refused(tmp_path: Path, source: str, problem: str) -> None:
    (told,) = _problems(tmp_path, f"source:\n  kind: {source}")
    assert told.startswith(f"drone.yaml:{problem}")
