"""The cameras of a drone, from the configuration that it tells its watchers."""

from __future__ import annotations

import json
from typing import NamedTuple

from flockd.core.config.rig import CameraConfig, RigConfig
from flockd.flight.geometry import RigCamera, build_rig
from flockd.onboard.telemetry.topics import AboutMessage


class DroneCamera(NamedTuple):
    """One camera of a drone, as its configuration has it."""

    config: CameraConfig
    mounted: RigCamera


def cameras_of(about: AboutMessage | None) -> dict[str, DroneCamera]:
    """A drone's cameras by name; none where its configuration is not known or cannot be."""
    try:
        config = RigConfig.model_validate_json(json.dumps((about or {"configuration": {}})["configuration"].get("rig")))
        mounted = build_rig(config).cameras
    except (ValueError, ArithmeticError, RecursionError):  # of a peer of another version, or a hostile one
        return {}
    return {camera.name: DroneCamera(camera, mounted[camera.name]) for camera in config.cameras}
