"""What commands that detect drones in pictures have in common: the networks, and the camera of a picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.options import loaded
from flockd.cli.parser import Parser, option, positive_number, whole_number
from flockd.core.errors import UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.core.config.perception import PerceptionConfig
    from flockd.flight.geometry import Camera

MAX_FOV_DEG = 170.0


def add_picture_options(parser: Parser) -> None:
    """Adds the camera and the networks."""
    camera = parser.add_argument_group("the camera of the pictures, one of")
    option(
        camera,
        "--fov DEG",
        "field of view across the longer side, of a lens without distortion; above 100, of a fisheye",
        _fov,
    )
    option(camera, "--config FILE", "this drone's camera, networks and settings", Path)
    option(camera, "--camera NAME", "which of --config's cameras, where it has several")
    networks = parser.add_argument_group("the networks", "by default those of --config, else flockd's own")
    option(networks, "--models FOLDER", "folder of the manifests", Path)
    option(networks, "--first-stage NAME", "the model for depth and segmentation")
    option(networks, "--detector NAME", "the model for boxes of drones, or `none`")
    option(networks, "--second-stage NAME", "the model for the distance")
    option(networks, "--verification NAME", "the model that verifies detections, or `none`")
    option(networks, "--threads N", "processor threads (2)", whole_number("a number of threads, 1 to 64", 1, 64))


def _fov(text: str) -> float:
    angle = positive_number(text)
    if angle > MAX_FOV_DEG:
        raise argparse.ArgumentTypeError(
            f"{text} degrees are more than {MAX_FOV_DEG:g}; name such a camera with --config"
        )
    return angle


class PictureCameras:
    """The camera of each picture, by its size."""

    def __init__(self, args: argparse.Namespace) -> None:
        """Raises UsageError where the options give none or two, and ConfigError."""
        if args.config is None and args.fov is None:
            raise UsageError(
                "the pictures' camera is not known; give its field of view with --fov (a phone's main camera has 65 to "
                "75 degrees, its data sheet says), or a drone with --config"
            )
        if args.config is not None and args.fov is not None:
            raise UsageError("--fov and --config exclude each other; give one of them")
        if args.camera is not None and args.config is None:
            raise UsageError("--camera is one of --config's; name the drone's file with --config")
        self.config = loaded(args.config)
        self._file, self._fov = args.config, args.fov
        self._mine = None if self.config is None else self._of_rig(args)

    def of(self, name: str, size: tuple[int, int]) -> Camera:
        """The camera for a picture of this width and height. Raises UsageError where --config's camera has another
        size."""
        if self._mine is not None:
            if self._mine.size != size:
                wanted = " x ".join(map(str, self._mine.size))
                raise UsageError(
                    f"{name}: is {size[0]} x {size[1]} pixels, and the camera of {self._file} {wanted}; give pictures "
                    "of that camera, or --fov instead of --config"
                )
            return self._mine
        from flockd.ground.pictures.single_frame import camera_with_fov

        return camera_with_fov(size, self._fov)

    def _of_rig(self, args: argparse.Namespace) -> Camera:
        from flockd.flight.geometry import build_rig

        assert self.config is not None
        cameras = build_rig(self.config.rig).cameras
        if args.camera is None and len(cameras) > 1:
            raise UsageError(f"{args.config}: has cameras {', '.join(cameras)}; choose one with --camera")
        name = args.camera or next(iter(cameras))
        if name not in cameras:
            raise UsageError(f"{args.config}: has no camera {name!r}; choose --camera from {', '.join(cameras)}")
        return cameras[name].camera


def perception_of(args: argparse.Namespace, drone: DroneConfig | None, **more: Any) -> PerceptionConfig:
    """The settings of a drone or the defaults, with what the options and ``more`` ask for.

    Raises UsageError for values that cannot be.
    """
    from pydantic import ValidationError

    from flockd.core.config.perception import PerceptionConfig

    values = {} if drone is None else drone.perception.model_dump()
    values |= more
    if args.models is not None:
        values["models_dir"] = str(args.models)
    if args.first_stage is not None:
        values |= {"depth": args.first_stage, "segmentation": args.first_stage}
    if args.second_stage is not None:
        values["distance"] = args.second_stage
    if args.detector is not None:
        values["detector"] = args.detector
    if args.verification is not None:
        values["verification"] = args.verification
    if args.threads is not None:
        values["threads"] = args.threads
    try:
        return PerceptionConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"perception.{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
