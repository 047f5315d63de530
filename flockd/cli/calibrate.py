"""`flockd calibrate`: measures the cameras of a drone."""

from __future__ import annotations

from flockd.cli import calibrate_camera, calibrate_rig
from flockd.cli.parser import Commands, add_commands


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate camera --print-board board.pdf",
        "flockd calibrate camera pictures/ --camera front",
        "flockd calibrate rig --config my_drone.yaml",
    )
    parser = commands("calibrate", "Measure the cameras: their lenses, where they sit, and their time.", examples)
    add_commands(parser, (calibrate_camera.add, calibrate_rig.add))
