"""`flockd calibrate`: measures the cameras of a drone, and the drone."""

from __future__ import annotations

from flockd.cli import calibrate_camera, calibrate_drone, calibrate_rig
from flockd.cli.parser import Commands, add_commands


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate camera --print-board board.pdf",
        "flockd calibrate camera pictures/ --camera front",
        "flockd calibrate rig --config my_drone.yaml",
        "flockd calibrate drone --distance 3.0 a.jpg b.jpg --distance 5.0 c.jpg d.jpg --fov 70",
    )
    parser = commands(
        "calibrate", "Measure the cameras (lenses, mountings, time offsets) and the drones' size.", examples
    )
    add_commands(parser, (calibrate_camera.add, calibrate_rig.add, calibrate_drone.add))
