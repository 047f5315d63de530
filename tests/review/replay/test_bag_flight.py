"""Bags of somebody else's stack, made here by `rosbags`: their images and odometry become a flight that is replayed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.messages import FloatArray, UInt8Array
from flockd.onboard.recording.reader import Recording
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


def bag(folder: Path, states: str = ODOMETRY, topics: tuple[str, ...] = ("/odom",)) -> Path:
    """A second of two cameras at 10 Hz, the second one 20 ms late, and states at 50 Hz."""
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
                write(topic, states, time_ns, odometry(time_ns, place) if "Odom" in states else imu(time_ns))
            if tick % 5 == 0:
                front = picture(tick, "front")
                image = kind("sensor_msgs/msg/Image")(
                    header=header(time_ns), height=48, width=64, encoding="bgr8", is_bigendian=0, step=192,
                    data=np.ascontiguousarray(front[..., ::-1]).ravel(),
                )  # fmt: skip
                write("/front/image_raw", "sensor_msgs/msg/Image", time_ns, image)
            if tick % 5 == 1:
                data = cv2.imencode(".png", cv2.cvtColor(picture(tick - 1, "back"), cv2.COLOR_RGB2BGR))[1]
                small = kind("sensor_msgs/msg/CompressedImage")(
                    header=header(time_ns), format="png", data=np.frombuffer(data.tobytes(), np.uint8)
                )
                write("/back/image_raw/compressed", "sensor_msgs/msg/CompressedImage", time_ns, small)
    return folder


def config_file(folder: Path, **changes: Any) -> Path:
    file = folder / "theirs.yaml"
    file.write_text(yaml.safe_dump({**DRONE, **changes}), encoding="utf-8")
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
