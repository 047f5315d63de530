"""Recordings as bags of ROS 2 and back, read by `rosbags` too: nothing is lost that flockd needs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from flockd.cli import main
from flockd.core.config.recording import RecordingConfig
from flockd.core.messages import Neighbour, VehicleState
from flockd.onboard.recording import Recorder, Recording, RecordingError
from flockd.onboard.recording.bag_export import export_bag
from flockd.onboard.recording.codec import to_json
from flockd.onboard.recording.ros_bag import Storage
from tests.onboard.recording.made_up import MadeUpPilot, drone_config, inputs, record

STORAGES: tuple[Storage, ...] = ("mcap", "sqlite3")
POSITION = np.array([3.0, -2.0])
VELOCITY = np.array([0.5, 1.0, -0.25])
EAST = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""R_ned_body of a level drone that faces east."""


def bag_of(path: Path, folder: Path, storage: Storage = "mcap") -> Path:
    recording = Recording(path)
    export_bag(recording.contents.paths, recording.drone, recording.config, folder, storage)
    return folder


def known_flight(path: Path, steps: int = 4) -> None:
    """Level, facing east, with everything that a standard message can hold known."""
    seen = Neighbour(7, np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]), 0.5, 0.2, 4.0, 0.25, 3, True)
    config = drone_config()
    pilot = MadeUpPilot(config)
    with Recorder(path, drone="drone-1", config=config, settings=RecordingConfig(images="png")) as recorder:
        for frames, _ in inputs(steps):
            vehicle = VehicleState(frames.time_s, EAST, 5.0, VELOCITY, POSITION)
            output = replace(pilot.step(frames, vehicle), neighbours=(seen,))
            recorder.drain()
            recorder.step(frames, vehicle, output)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_is_the_same_recording(tmp_path: Path, storage: Storage) -> None:
    """Every number of every step, every pixel, and what the flight flew with; `Recording` opens the bag itself."""
    record(tmp_path / "flight.mcap")
    flown, read = (
        Recording(tmp_path / "flight.mcap"),
        Recording(bag_of(tmp_path / "flight.mcap", tmp_path / "bag", storage)),
    )
    assert (read.drone, read.config, read.contents.models) == (flown.drone, flown.config, flown.contents.models)
    assert dict(read.contents.flight) == dict(flown.contents.flight)
    assert read.contents.steps == flown.contents.steps
    for one, other in zip(flown.steps(), read.steps(), strict=True):
        assert to_json(one.vehicle) == to_json(other.vehicle)
        assert one.output == other.output
        assert one.frames.time_s == other.frames.time_s
        for name, frame in one.frames.frames.items():
            again = other.frames.frames[name]
            assert np.array_equal(frame.image, again.image)
            assert (frame.time_s, frame.sequence) == (again.time_s, again.sequence)


@pytest.mark.parametrize("storage", STORAGES)
def test_another_reader_finds_standard_messages(tmp_path: Path, storage: Storage) -> None:
    """`rosbags`, which knows nothing of flockd: values worked out by hand, in the axes of REP 103."""
    known_flight(tmp_path / "flight.mcap")
    bag = bag_of(tmp_path / "flight.mcap", tmp_path / "bag", storage)
    found: dict[str, list[Any]] = {}
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    odometry = found["/drone_1/odometry"]
    assert len(odometry) == 4
    pose, motion = odometry[0].pose.pose, odometry[0].twist.twist
    np.testing.assert_allclose([pose.position.x, pose.position.y, pose.position.z], [-2.0, 3.0, 5.0], atol=1e-9)
    np.testing.assert_allclose([pose.orientation.z, pose.orientation.w], [0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose([motion.linear.x, motion.linear.y, motion.linear.z], [1.0, 0.5, 0.25], atol=1e-9)
    assert (odometry[0].header.frame_id, odometry[0].child_frame_id) == ("drone_1/odom", "drone_1/base_link")
    stamp = odometry[0].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == round(1e9 * (1000.0 + 1 / 3e6))
    (neighbour,) = found["/drone_1/neighbours"][0].poses
    assert [neighbour.position.x, neighbour.position.y, neighbour.position.z] == [2.0, 1.0, -3.0]
    assert found["/drone_1/neighbours/tracks"][0].width == 1
    assert {image.format for image in found["/drone_1/camera/front/image/compressed"]} == {"png"}
    assert found["/drone_1/camera/front/camera_info"][0].k[0] == 80.0
    assert found["/drone_1/imu"][0].angular_velocity_covariance[0] == -1.0
    (places,) = found["/tf_static"]
    assert [one.child_frame_id for one in places.transforms] == ["drone_1/front_optical", "drone_1/left_optical"]
    assert math.isfinite(found["/drone_1/command"][0].twist.linear.x)


def test_a_bag_of_somebody_else_is_no_recording(tmp_path: Path) -> None:
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9) as writer:
        writer.add_connection("/x", "std_msgs/msg/String", typestore=store)
    with pytest.raises(RecordingError, match="is a bag, but none of flockd"):
        Recording(tmp_path / "bag")


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_that_is_damaged_is_one_sentence(
    tmp_path: Path, storage: Storage, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "flight.mcap")
    bag = bag_of(tmp_path / "flight.mcap", tmp_path / "bag", storage)
    (data,) = (file for file in bag.iterdir() if file.suffix != ".yaml")
    data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])
    assert main(["record", "info", str(bag)]) != 0
    told = capsys.readouterr().err
    assert str(bag) in told
    assert "Traceback" not in told
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: 7\n", encoding="utf-8")
    assert main(["record", "info", str(bag)]) != 0
    assert "is no bag that can be read" in capsys.readouterr().err


def test_the_command_writes_one_whole_bag_or_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "flight.mcap")
    bag = tmp_path / "bag"
    assert main(["record", "export", str(tmp_path / "flight.mcap"), "--ros2", "--out", str(bag)]) == 0
    assert {file.name for file in bag.iterdir()} == {"metadata.yaml", "bag.mcap"}
    assert main(["record", "export", str(tmp_path / "flight.mcap"), "--ros2", "--out", str(bag)]) == 2
    assert main(["record", "info", str(bag)]) == 0
    assert "drone1" in capsys.readouterr().out
    tables = tmp_path / "tables"
    assert main(["record", "export", str(bag), "--out", str(tables)]) == 0, "a bag is a recording for every command"
    assert (tables / "output.csv").is_file()
