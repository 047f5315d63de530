"""Bags of somebody else's stack, made here by `rosbags`: their images and odometry become a flight that is replayed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.config.rig import IntrinsicsConfig
from flockd.core.messages import FloatArray, UInt8Array
from flockd.onboard.recording import RecordingError
from flockd.onboard.recording.reader import Recording
from flockd.onboard.sources.camera_child import numbers_of
from flockd.onboard.sources.ros_device import info_fault
from flockd.review.replay.bag_flight import Bag, recording_of_bag
from tests.onboard.recording.made_up import MadeUpPilot

STORE = get_typestore(Stores.ROS2_JAZZY)
BEGAN_NS = 1_790_000_000_000_000_007
"""As of today's clocks: too large for microseconds in a float."""
SIZE = (64, 48)
DRONE = {
    "name": "theirs",
    "step_s": 0.2,
    "rig": {
        "cameras": [
            {"name": name, "size_px": list(SIZE), "intrinsics": {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0}}
            for name in ("front", "back")
        ]
    },
    "source": {
        "kind": "ros",
        "cameras": [
            {"name": "front", "topic": "/front/image_raw", "rate_hz": 10},
            {"name": "back", "topic": "/back/image_raw/compressed", "rate_hz": 10},
        ],
        "set_tolerance_s": 0.06,
    },
}


def kind(name: str) -> Any:
    return STORE.types[name]


def header(time_ns: int) -> Any:
    stamp = kind("builtin_interfaces/msg/Time")(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return kind("std_msgs/msg/Header")(stamp=stamp, frame_id="x")


def picture(number: int, camera: str) -> UInt8Array:
    rng = np.random.default_rng([number, len(camera)])
    return rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def pose(place: FloatArray, yaw_rad: float) -> Any:
    point = kind("geometry_msgs/msg/Point")(*place.tolist())
    turn = kind("geometry_msgs/msg/Quaternion")(0.0, 0.0, float(np.sin(yaw_rad / 2)), float(np.cos(yaw_rad / 2)))
    return kind("geometry_msgs/msg/Pose")(position=point, orientation=turn)


def odometry(time_ns: int, place: FloatArray) -> Any:
    """Facing north, 2 m/s ahead."""
    vector = kind("geometry_msgs/msg/Vector3")
    motion = kind("geometry_msgs/msg/Twist")(linear=vector(2.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    with_pose = kind("geometry_msgs/msg/PoseWithCovariance")(pose=pose(place, np.pi / 2), covariance=np.zeros(36))
    with_twist = kind("geometry_msgs/msg/TwistWithCovariance")(twist=motion, covariance=np.zeros(36))
    return kind("nav_msgs/msg/Odometry")(
        header=header(time_ns), child_frame_id="base_link", pose=with_pose, twist=with_twist
    )


def imu(time_ns: int) -> Any:
    vector, turn = kind("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0), pose(np.zeros(3), np.pi / 2).orientation
    return kind("sensor_msgs/msg/Imu")(
        header=header(time_ns), orientation=turn, orientation_covariance=np.zeros(9), angular_velocity=vector,
        angular_velocity_covariance=np.zeros(9), linear_acceleration=vector, linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


ODOMETRY = "nav_msgs/msg/Odometry"


def info(time_ns: int, focal_px: float, d: tuple[float, ...]) -> Any:
    """Pixel centres at whole numbers."""
    roi = kind("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
    k = np.array([focal_px, 0.0, 31.5, 0.0, focal_px, 23.5, 0.0, 0.0, 1.0])
    return kind("sensor_msgs/msg/CameraInfo")(
        header=header(time_ns), height=48, width=64, distortion_model="plumb_bob", d=np.array(d), k=k,
        r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


PX4 = "px4_msgs/msg/VehicleOdometry"
STORE.register(
    get_types_from_msg(
        "uint64 timestamp\nuint8 pose_frame\nfloat32[3] position\nfloat32[4] q\n"
        "uint8 velocity_frame\nfloat32[3] velocity",
        PX4,
    )
)


def px4_odometry(stamp_us: int, place: FloatArray) -> Any:
    """In NED, facing east: the body's 2 m/s ahead are east."""
    turn = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], np.float32)
    position, ahead = place.astype(np.float32), np.array([2.0, 0.0, 0.0], np.float32)
    return kind(PX4)(timestamp=stamp_us, pose_frame=1, position=position, q=turn, velocity_frame=3, velocity=ahead)


def bag(
    folder: Path,
    states: str = ODOMETRY,
    topics: tuple[str, ...] = ("/odom",),
    *,
    corner: tuple[int, int, int] | None = None,
    small: tuple[str, bytes] | None = None,
    focal_px: float | None = None,
    d: tuple[float, ...] = (0.0,) * 5,
    spoil: Callable[[Any, int], Any] = lambda message, tick: message,
) -> Path:
    """A second of two cameras at 10 Hz, the second one 20 ms late, and states at 50 Hz.

    ``corner``: BGR of the first one's first pixel; ``small``: format and data of the second one's images; ``focal_px``,
    ``d``: of the first one's CameraInfo; ``spoil``: of a state and its number, what is written; None: nothing.
    """
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}

        def write(topic: str, name: str, time_ns: int, message: Any) -> None:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=STORE)
            writer.write(connections[topic], time_ns, STORE.serialize_cdr(message, name))

        for tick in range(50):
            time_ns = BEGAN_NS + 20_000_000 * tick
            for topic in topics:
                place = np.array([1.0, 0.04 * tick, 3.0])
                if states == PX4:
                    own_us = 20_000 * tick if topic == "/own" else time_ns // 1000
                    message = px4_odometry(own_us, np.array([1.0, 0.04 * tick, -3.0]))
                else:
                    message = odometry(time_ns, place) if "Odom" in states else imu(time_ns)
                if (spoilt := spoil(message, tick)) is not None:
                    write(topic, states, time_ns, spoilt)
            if tick % 5 == 0:
                front = picture(tick, "front")
                if corner is not None:
                    front[0, 0] = corner[::-1]
                if focal_px is not None:
                    write("/front/camera_info", "sensor_msgs/msg/CameraInfo", time_ns, info(time_ns, focal_px, d))
                image = kind("sensor_msgs/msg/Image")(
                    header=header(time_ns), height=48, width=64, encoding="bgr8", is_bigendian=0, step=192,
                    data=np.ascontiguousarray(front[..., ::-1]).ravel(),
                )  # fmt: skip
                write("/front/image_raw", "sensor_msgs/msg/Image", time_ns, image)
            if tick % 5 == 1:
                data = cv2.imencode(".png", cv2.cvtColor(picture(tick - 1, "back"), cv2.COLOR_RGB2BGR))[1]
                form, sent = small or ("png", data.tobytes())
                message = kind("sensor_msgs/msg/CompressedImage")(
                    header=header(time_ns), format=form, data=np.frombuffer(sent, np.uint8)
                )
                write("/back/image_raw/compressed", "sensor_msgs/msg/CompressedImage", time_ns, message)
    return folder


def config_file(folder: Path, **changes: Any) -> Path:
    file = folder / "theirs.yaml"
    file.write_text(json.dumps({**DRONE, **changes}), encoding="utf-8")
    return file


def test_sets_states_and_steps_are_those_that_a_drone_would_have(tmp_path: Path) -> None:
    config = load_drone(config_file(tmp_path))
    with Bag(bag(tmp_path / "bag")) as theirs:
        assert recording_of_bag(theirs, config, None, tmp_path / "flight.mcap") == 5, "1 s, a step every 0.2 s"
    recording = Recording(tmp_path / "flight.mcap")
    steps = list(recording.steps())
    assert [round(step.frames.time_s, 3) for step in steps] == [0.02, 0.22, 0.42, 0.62, 0.82]
    for number, step in enumerate(steps):
        for name in ("front", "back"):
            assert np.array_equal(step.frames.frames[name].image, picture(10 * number, name))
        assert step.frames.frames["front"].time_s == pytest.approx(0.2 * number, abs=1e-9)
        # Facing north: east 1 m, north 2 m/s; 3 m above where its odometry began.
        np.testing.assert_allclose(step.vehicle.R_ned_body, np.eye(3), atol=1e-9)
        assert step.vehicle.position is not None
        np.testing.assert_allclose(step.vehicle.position, [0.04 + 0.4 * number, 1.0], atol=1e-9)
        assert step.vehicle.velocity_ned is not None
        np.testing.assert_allclose(step.vehicle.velocity_ned, [2.0, 0.0, 0.0], atol=1e-9)
        assert step.vehicle.height_m == 3.0


def test_the_command_flies_the_bag_and_writes_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", MadeUpPilot)
    theirs, file, out = bag(tmp_path / "bag"), config_file(tmp_path), tmp_path / "again.mcap"
    assert main(["replay", str(theirs), "--config", str(file), "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 5
    assert main(["replay", str(out), "--diff"]) == 0, "and that is a recording like any other"
    theirs = bag(tmp_path / "of_imu", "sensor_msgs/msg/Imu", ("/imu",))
    file = config_file(tmp_path, perception={"scale": "network"})
    assert main(["replay", str(theirs), "--config", str(file)]) == 0, "an IMU is enough where scale is the networks'"


@pytest.mark.parametrize(
    ("states", "topics", "options", "changes", "sentence"),
    [
        (ODOMETRY, ("/odom",), [], None, "is a bag of ROS 2; name a drone with --config"),
        (ODOMETRY, ("/a", "/b"), [], {}, "has several topics of nav_msgs/msg/Odometry; name one with --vehicle"),
        (ODOMETRY, ("/a",), ["--vehicle", "/b"], {}, "/b is not in it; name one of nav_msgs/msg/Odometry"),
        (ODOMETRY, (), [], {}, "has no odometry, pose or IMU"),
        ("sensor_msgs/msg/Imu", ("/imu",), [], {}, "/imu has an attitude and no height; set perception.scale"),
        (ODOMETRY, ("/odom",), [], {"source": {"kind": "shared_memory"}}, "is a bag of ROS 2; replay it"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], states: str, topics: tuple[str, ...], options: list[str],
    changes: dict[str, Any] | None, sentence: str,
) -> None:  # fmt: skip
    theirs = bag(tmp_path / "bag", states, topics)
    given = [] if changes is None else ["--config", str(config_file(tmp_path, **changes))]
    assert main(["replay", str(theirs), *given, *options]) != 0
    assert sentence in capsys.readouterr().err


def test_a_raw_image_that_begins_as_a_jpeg_does_is_a_raw_image(tmp_path: Path) -> None:
    """Its first pixel is of a light blue: 0xff, 0xd8."""
    with Bag(bag(tmp_path / "bag", corner=(0xFF, 0xD8, 0x96))) as theirs:
        recording_of_bag(theirs, load_drone(config_file(tmp_path)), None, tmp_path / "flight.mcap")
    for step in Recording(tmp_path / "flight.mcap").steps():
        assert step.frames.frames["front"].image[0, 0].tolist() == [0x96, 0xD8, 0xFF]


JPEG = bytes(cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8))[1])
"""Of twice the size."""


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"small": ("h264", b"\0\0\0\1")}, "/back/image_raw/compressed: sends 'h264'; let its transport send JPEG"),
        ({"small": ("16UC1; compressedDepth png", b"x")}, "sends '16UC1; compressedDepth png'"),
        ({"focal_px": 100.0}, "camera front: /front/camera_info has fx 100.0, but the rig 50.0; correct one"),
        (
            {"focal_px": 50.0, "d": (-0.3, 0.1, 0.0, 0.0)},
            "/front/camera_info shows 73 degrees by its D, but the rig 65",
        ),
    ],
)
def test_images_and_lenses_that_a_drone_would_refuse_are_refused(
    tmp_path: Path, given: dict[str, Any], sentence: str
) -> None:
    with Bag(bag(tmp_path / "bag", **given)) as theirs, pytest.raises(RecordingError, match=re.escape(sentence)):
        recording_of_bag(theirs, load_drone(config_file(tmp_path)), None, tmp_path / "flight.mcap")


def test_a_camera_info_without_coefficients_contradicts_no_lens() -> None:
    k = [50.0, 0.0, 31.5, 0.0, 50.0, 23.5, 0.0, 0.0, 1.0]
    fisheye = IntrinsicsConfig(model="wide_angle", fx=50.0, fy=50.0, cx=32.0, cy=24.0, distortion=(0.02, 0.0, 0.0, 0.0))
    for d, fault in ((), None), ((0.0,) * 5, "degrees by its D"):
        found = numbers_of(SimpleNamespace(width=64, height=48, k=k, d=d, distortion_model="plumb_bob"))
        told = info_fault(fisheye, (64, 48), "/front/image_raw", found)
        assert told is None if fault is None else fault in str(told)


def test_images_that_cannot_be_used_are_counted_and_without_any_there_is_no_flight(tmp_path: Path) -> None:
    theirs, file, told = bag(tmp_path / "bag", small=("bgr8; jpeg", JPEG)), config_file(tmp_path), list[str]()
    with Bag(theirs) as opened:
        recording_of_bag(opened, load_drone(file), None, tmp_path / "flight.mcap", told.append)
    why = "5 of camera back: frozen; 3 of camera back: JPEG has 128x96 instead of 64x48"
    assert told == [f"{theirs}: 8 images could not be used: {why}"]
    alone: Any = {key: [DRONE[key]["cameras"][1]] for key in ("rig", "source")}  # type: ignore[index]
    changes = {key: {**DRONE[key], "cameras": alone[key]} for key in alone}  # type: ignore[dict-item]
    with Bag(theirs) as opened, pytest.raises(RecordingError, match=f"none of its images could be used .{why}"):
        recording_of_bag(opened, load_drone(config_file(tmp_path, **changes)), None, tmp_path / "back.mcap")


def in_ned(message: Any, tick: int) -> Any:
    return replace(message, header=replace(message.header, frame_id="odom_ned"))


def without_attitude(message: Any, tick: int) -> Any:
    message.pose.pose.orientation.z = message.pose.pose.orientation.w = 0.0
    return message


def of_unknown_attitude(message: Any, tick: int) -> Any:
    """As REP-145 and the message's definition say it."""
    message.pose.covariance[0] = -1.0
    return message


@pytest.mark.parametrize("spoil", [in_ned, without_attitude, of_unknown_attitude])
def test_states_that_are_none_are_told_instead_of_their_clocks(
    tmp_path: Path, spoil: Callable[[Any, int], Any]
) -> None:
    theirs, config = bag(tmp_path / "bag", spoil=spoil), load_drone(config_file(tmp_path))
    told = "bag: 50 of 50 states of /odom have no attitude or place in ENU and FLU; name another topic"
    with Bag(theirs) as opened, pytest.raises(RecordingError, match=told):
        recording_of_bag(opened, config, None, tmp_path / "flight.mcap")


def in_other_axes(message: Any, tick: int) -> Any:
    """Velocities of the world, not of the body, which faces north and flies there."""
    message.twist.twist.linear.x, message.twist.twist.linear.y = 0.0, 2.0
    return message


def in_millimetres(message: Any, tick: int) -> Any:
    message.pose.pose.position.y *= 1000.0
    return message


def w_first(message: Any, tick: int) -> Any:
    turn = message.pose.pose.orientation
    turn.x, turn.y, turn.z, turn.w = turn.w, turn.x, turn.y, turn.z
    return message


def on_the_ground(message: Any, tick: int) -> Any:
    message.pose.pose.position.z = 0.0
    return message


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (
            in_other_axes,
            "/odom says 2.0 m/s, and its positions move by 2.0 m/s, or another way; give metres, velocities",
        ),
        (in_millimetres, "/odom says 2.0 m/s, and its positions move by 2000.0 m/s, or another way; give metres"),
        (w_first, "/odom has the drone on its side, or upside down; give attitudes in the order x, y, z, w"),
        (on_the_ground, "/odom is never above 0 m, and perception.scale is `height`; give heights"),
    ],
)
def test_odometry_that_contradicts_itself_or_the_configuration_is_refused(
    tmp_path: Path, spoil: Callable[[Any, int], Any], sentence: str
) -> None:
    config = load_drone(config_file(tmp_path, perception={"scale": "height"}))
    with Bag(bag(tmp_path / "bag", spoil=spoil)) as opened, pytest.raises(RecordingError, match=re.escape(sentence)):
        recording_of_bag(opened, config, None, tmp_path / "flight.mcap")


def test_images_without_a_state_are_counted(tmp_path: Path) -> None:
    """States end at 0.5 s; from 0.7 s on no frame set has one."""
    theirs, told = bag(tmp_path / "bag", spoil=lambda message, tick: message if tick <= 25 else None), list[str]()
    with Bag(theirs) as opened:
        recording_of_bag(opened, load_drone(config_file(tmp_path)), None, tmp_path / "flight.mcap", told.append)
    why = "6 of all cameras: no state of the vehicle within 0.2 s"
    assert told == [f"{theirs}: 6 images could not be used: {why}"]


@pytest.mark.parametrize(
    "stamp_ns",
    [
        lambda ns: 0,
        lambda ns: ns // 1000,
        lambda ns: 2 * BEGAN_NS - ns,
        lambda ns: ns + (ns > BEGAN_NS + 5e8) * 36 * 10**11,
    ],
    ids=["zero", "microseconds", "backwards", "an hour ahead from the middle on"],
)
def test_stamps_that_do_not_advance_with_the_recording_are_refused(
    stamp_ns: Callable[[int], int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was a flight of one step, or of an hour, with exit code 0."""
    right = header
    monkeypatch.setattr(f"{__name__}.header", lambda time_ns: right(stamp_ns(time_ns)))
    (tmp_path / "theirs.yaml").write_text(json.dumps(DRONE), encoding="utf-8")
    with (
        Bag(bag(tmp_path / "bag")) as theirs,
        pytest.raises(RecordingError, match="stamps of /front/image_raw advance"),
    ):
        recording_of_bag(theirs, load_drone(tmp_path / "theirs.yaml"), None, tmp_path / "ours.mcap")


def test_a_part_of_a_bag_is_told_to_be_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    theirs = bag(tmp_path / "bag")
    assert main(["replay", str(theirs / "bag.mcap")]) == 1
    assert "is a part of a bag of ROS 2; `flockd replay` takes the bag's folder" in capsys.readouterr().err
    for text in ("hello", "rosbag2_bagfile_information: {version: 5, storage_identifier: mcap}"):
        (theirs / "metadata.yaml").write_text(text)
        assert main(["replay", str(theirs), "--config", str(config_file(tmp_path))]) == 1
        told = f"its metadata.yaml is not whole; write it again with `ros2 bag reindex {theirs}`"
        assert told in capsys.readouterr().err
    (theirs / "metadata.yaml").unlink()
    assert main(["replay", str(theirs)]) == 1
    assert "write the metadata.yaml of a bag with `ros2 bag reindex`" in capsys.readouterr().err


@pytest.mark.parametrize("topic", ["/fmu/out/vehicle_odometry", "/own"])
def test_px4s_own_odometry_is_the_vehicles_state(topic: str, tmp_path: Path) -> None:
    """On either clock: the bag's, or since PX4's start, which is told."""
    told = list[str]()
    with Bag(bag(tmp_path / "bag", PX4, (topic,))) as theirs:
        recording_of_bag(theirs, load_drone(config_file(tmp_path)), None, tmp_path / "flight.mcap", told.append)
    assert ["of the autopilot's own clock" in one for one in told] == ([True] if topic == "/own" else [])
    steps = list(Recording(tmp_path / "flight.mcap").steps())
    assert len(steps) == 5
    for number, step in enumerate(steps):
        assert (step.vehicle.position is not None, step.vehicle.velocity_ned is not None) == (True, True)
        np.testing.assert_allclose(step.vehicle.position, [1.0, 0.04 + 0.4 * number], atol=1e-6)  # type: ignore[arg-type]
        np.testing.assert_allclose(step.vehicle.velocity_ned, [0.0, 2.0, 0.0], atol=1e-6)  # type: ignore[arg-type]
        np.testing.assert_allclose(step.vehicle.R_ned_body[:, 0], [0.0, 1.0, 0.0], atol=1e-6)
        assert step.vehicle.height_m == 3.0


NAMES = ("front", "right", "back", "left")


def test_four_parts_of_one_topic_are_replayed_as_four_topics(tmp_path: Path) -> None:
    """The same pictures: of a topic each, and side by side in one topic, with a crop each."""
    recordings = {}
    for folder in ("four", "one"):
        with Writer(tmp_path / folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics = [f"/{name}/image_raw" for name in NAMES] if folder == "four" else ["/board/image_raw"]
            kinds = dict.fromkeys(topics, "sensor_msgs/msg/Image") | {"/odom": ODOMETRY}
            connections = {one: writer.add_connection(one, name, typestore=STORE) for one, name in kinds.items()}
            for tick in range(5):
                time_ns = BEGAN_NS + 100_000_000 * tick
                shown = [picture(10 * tick + number, name) for number, name in enumerate(NAMES)]
                sent: list[Any] = shown if folder == "four" else [np.concatenate(shown, axis=1)]
                messages = {"/odom": odometry(time_ns, np.array([0.0, 0.1 * tick, 3.0]))}
                messages |= {topic: raw(time_ns, image) for topic, image in zip(topics, sent, strict=True)}
                for topic, message in messages.items():
                    writer.write(connections[topic], time_ns, STORE.serialize_cdr(message, kinds[topic]))
        cameras = [{"name": name, "topic": f"/{name}/image_raw", "rate_hz": 10} for name in NAMES]
        if folder == "one":
            crops = [{"topic": "/board/image_raw", "crop": [64 * number, 0, *SIZE]} for number in range(4)]
            cameras = [camera | crop for camera, crop in zip(cameras, crops, strict=True)]
        rig = [DRONE["rig"]["cameras"][0] | {"name": name} for name in NAMES]  # type: ignore[index]
        source = DRONE["source"] | {"cameras": cameras}  # type: ignore[operator]
        config = load_drone(config_file(tmp_path, rig={"cameras": rig}, source=source))
        with Bag(tmp_path / folder) as theirs:
            told = list[str]()
            assert recording_of_bag(theirs, config, None, tmp_path / f"{folder}.mcap", told.append) == 3
            assert told == []
        recordings[folder] = list(Recording(tmp_path / f"{folder}.mcap").steps())
    for number, (four, one) in enumerate(zip(recordings["four"], recordings["one"], strict=True)):
        assert four.frames.frames.keys() == one.frames.frames.keys() == {*NAMES}
        for place, name in enumerate(NAMES):
            a, b = four.frames.frames[name], one.frames.frames[name]
            assert (a.time_s, a.sequence) == (b.time_s, b.sequence)
            assert np.array_equal(a.image, b.image)
            assert np.array_equal(b.image, picture(20 * number + place, name))


def raw(time_ns: int, shown: UInt8Array) -> Any:
    height, width = shown.shape[:2]
    return kind("sensor_msgs/msg/Image")(
        header=header(time_ns), height=height, width=width, encoding="rgb8", is_bigendian=0, step=3 * width,
        data=shown.ravel(),
    )  # fmt: skip
