"""Perception alone: images and odometry of somebody else's nodes go in, neighbours come out. Run with `make ros`."""

from __future__ import annotations

import itertools
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flockd.cli import main
from flockd.onboard.recording.reader import Recording
from tests.calm import until
from tests.fleet.ros.peers import FLOCKD, Peer, ended, own_domain, peer
from tests.fleet.ros.px4_messages import px4_messages

FLIGHT = Path(__file__).parents[2] / "review" / "replay" / "crossing.mcap"
DRIVER = Path(__file__).with_name("ros_cameras.py")
STEPS = 6


def config_file(folder: Path, recording: Recording, **perception: Any) -> Path:
    """The flight's drone, whose cameras are topics."""
    values = recording.config.model_dump(mode="json", exclude_defaults=True)
    cameras = [
        {"name": camera.name, "topic": f"/{camera.name}/image_raw", "rate_hz": 2.0}
        for camera in recording.config.rig.cameras
    ]
    values["source"] = {
        "kind": "ros", "cameras": cameras, "silence_s": 30.0, "set_tolerance_s": 0.25, "set_wait_s": 5.0
    }  # fmt: skip
    values["name"] = "drone1"
    values["perception"] = {**values.get("perception", {}), **perception}
    file = folder / "drone.yaml"
    file.write_text(yaml.safe_dump(values), encoding="utf-8")
    return file


@contextmanager
def perceiving(
    folder: Path, environment: dict[str, str], *options: str, scale: str, **of_px4: Any
) -> Iterator[tuple[Peer, list[Any]]]:
    """The crossing flight's images are published; gives another node, and the first poses that have neighbours."""
    recording = Recording(FLIGHT)
    steps = list(itertools.islice(recording.steps(), STEPS))
    arrays: dict[str, Any] = of_px4
    for camera in recording.config.rig.cameras:
        lens = camera.intrinsics
        arrays[f"k_{camera.name}"] = np.array([lens.fx, 0, lens.cx - 0.5, 0, lens.fy, lens.cy - 0.5, 0, 0, 1.0])
        arrays[f"images_{camera.name}"] = np.stack([step.frames.frames[camera.name].image for step in steps])
    names = [camera.name for camera in recording.config.rig.cameras]
    # Slowly enough for a computer that is busy: 2 s a step.
    np.savez(folder / "flight.npz", names=names, stamps=2.0 * np.arange(STEPS), **arrays)
    config = config_file(folder, recording, scale=scale)
    command = [sys.executable, "-c", FLOCKD, "ros", "perceive", "--config", str(config), *options]
    with (
        peer(environment, "planner") as planner,
        ended(subprocess.Popen(command, env=environment, text=True)),
        ended(
            subprocess.Popen(
                [sys.executable, str(DRIVER), str(folder / "flight.npz")],
                env=environment, stdin=subprocess.PIPE, text=True,
            )
        ),
    ):  # fmt: skip
        planner.listen("/drone1/neighbours", "geometry_msgs/msg/PoseArray")
        planner.listen("/drone1/neighbours/tracks", "sensor_msgs/msg/PointCloud2")
        poses = until(
            lambda: [m["message"] for m in planner.heard("/drone1/neighbours") if m["message"]["poses"]], 120.0
        )
        yield planner, poses


@pytest.mark.ros
@pytest.mark.slow
def test_images_in_neighbours_out_and_nothing_commanded(tmp_path: Path) -> None:
    """The crossing flight's images: the drones that its own pilot saw are published, and nothing else."""
    with perceiving(tmp_path, own_domain(), scale="network") as (planner, poses):
        assert poses[0]["header"]["frame_id"] == "drone1/level"
        planner.newest("/drone1/neighbours/tracks")
        planner.do("topics")
        topics = until(lambda: planner.said("topics"))[0]["topics"]
        published = {topic for topic, nodes in topics.items() if "flockd_perceive" in nodes}
        told = {topic for topic in published if topic.startswith("/drone1/")}
        assert told == {"/drone1/neighbours", "/drone1/neighbours/tracks", "/drone1/diagnostics"}


@pytest.mark.ros
@pytest.mark.slow
def test_px4s_own_odometry_says_which_way_the_drone_faces(tmp_path: Path) -> None:
    """It faces east by a PX4 that stamps since its start: the drone ahead on the left is in the north-east."""
    environment = own_domain()
    environment["PYTHONPATH"] = os.pathsep.join([str(px4_messages(tmp_path / "px4")), *sys.path])
    facing_east = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], np.float32)
    vehicle = ("--vehicle", "/fmu/out/vehicle_odometry")
    with perceiving(tmp_path, environment, *vehicle, scale="height", px4=facing_east) as (_, poses):
        places = [(one["position"]["x"], one["position"]["y"]) for one in poses[0]["poses"]]
        # By the recording it is 2.3 to 2.7 m away, 34 to 45 degrees left of ahead.
        north_east = [place for place in places if 40.0 < math.degrees(math.atan2(*place)) < 61.0]
        assert [math.hypot(*place) for place in north_east] == [pytest.approx(2.5, abs=0.4)], places


def test_a_height_that_nobody_tells_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before ROS is asked for, in one sentence."""
    file = config_file(tmp_path, Recording(FLIGHT), scale="height")
    assert main(["ros", "perceive", "--config", str(file)]) == 2
    assert "name odometry or a pose with --vehicle" in capsys.readouterr().err
