"""Perception alone: images and odometry of somebody else's nodes go in, neighbours come out. Run with `make ros`."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flockd.cli import main
from flockd.onboard.recording.reader import Recording
from tests.calm import until
from tests.fleet.ros.peers import FLOCKD, ended, own_domain, peer

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


@pytest.mark.ros
@pytest.mark.slow
def test_images_in_neighbours_out_and_nothing_commanded(tmp_path: Path) -> None:
    """The crossing flight's images: the drones that its own pilot saw are published, and nothing else."""
    environment, recording = own_domain(), Recording(FLIGHT)
    steps = list(itertools.islice(recording.steps(), STEPS))
    arrays: dict[str, Any] = {}
    for camera in recording.config.rig.cameras:
        lens = camera.intrinsics
        arrays[f"k_{camera.name}"] = np.array([lens.fx, 0, lens.cx - 0.5, 0, lens.fy, lens.cy - 0.5, 0, 0, 1.0])
        arrays[f"images_{camera.name}"] = np.stack([step.frames.frames[camera.name].image for step in steps])
    names = [camera.name for camera in recording.config.rig.cameras]
    # Slowly enough for a computer that is busy: 2 s a step.
    np.savez(tmp_path / "flight.npz", names=names, stamps=2.0 * np.arange(STEPS), **arrays)
    config = config_file(tmp_path, recording, scale="network")
    command = [sys.executable, "-c", FLOCKD, "ros", "perceive", "--config", str(config)]
    with (
        peer(environment, "planner") as planner,
        ended(subprocess.Popen(command, env=environment, text=True)),
        ended(
            subprocess.Popen(
                [sys.executable, str(DRIVER), str(tmp_path / "flight.npz")],
                env=environment, stdin=subprocess.PIPE, text=True,
            )
        ),
    ):  # fmt: skip
        planner.listen("/drone1/neighbours", "geometry_msgs/msg/PoseArray")
        planner.listen("/drone1/neighbours/tracks", "sensor_msgs/msg/PointCloud2")
        poses = until(
            lambda: [m["message"] for m in planner.heard("/drone1/neighbours") if m["message"]["poses"]], 120.0
        )
        assert poses[0]["header"]["frame_id"] == "drone1/level"
        planner.newest("/drone1/neighbours/tracks")
        planner.do("topics")
        topics = until(lambda: planner.said("topics"))[0]["topics"]
        published = {topic for topic, nodes in topics.items() if "flockd_perceive" in nodes}
        told = {topic for topic in published if topic.startswith("/drone1/")}
        assert told == {"/drone1/neighbours", "/drone1/neighbours/tracks", "/drone1/diagnostics"}


def test_a_height_that_nobody_tells_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before ROS is asked for, in one sentence."""
    file = config_file(tmp_path, Recording(FLIGHT), scale="height")
    assert main(["ros", "perceive", "--config", str(file)]) == 2
    assert "name odometry or a pose with --vehicle" in capsys.readouterr().err
