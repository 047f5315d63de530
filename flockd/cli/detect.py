"""`flockd detect`: drones in pictures of any origin, by the code that flies."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from flockd.cli.options import camera_of, loaded
from flockd.cli.output import complain, progress, say_facts, say_table
from flockd.cli.parser import Commands, existing, flag, number, option, positive_count
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.core.config.perception import PerceptionConfig
    from flockd.flight.geometry import Camera
    from flockd.ground.pictures.copies import Copies
    from flockd.ground.pictures.picture_files import Picture, PictureFile
    from flockd.ground.pictures.single_frame import DetectedDrone, PictureDetector

MIN_FOV_DEG, MAX_FOV_DEG = 4.0, 170.0
"""Less are radians, or a telescope's."""
NOTES = """\
Larger pictures are resized to 1280 pixels for the networks; boxes are in pixels of the picture.
In a video each drone has a number, which it keeps from frame to frame; it is counted after half a second.
A picture that cannot be read is reported and left out, and the exit code is 1."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd detect photograph.jpg --fov 70 --out drawn",
        "flockd detect clip.mp4 --fov 70 --out annotated.mp4",
        "flockd detect pictures/ clip.mp4 --every 3 --fov 70 --json",
        "flockd detect front/ --config my_drone.yaml --camera front",
        "flockd detect photograph.jpg --fov 70 --drone-size 0.35",
    )
    parser = commands("detect", "Detect drones in pictures, with the code of the flight.", examples, _run, notes=NOTES)
    option(parser, "PICTURES", "images, folders of them, videos", existing, nargs="+")
    option(
        parser,
        "--out PATH",
        "write copies of the pictures with the detections drawn into them: a folder, or one .mp4",
        Path,
    )
    flag(parser, "--force", "overwrite existing files")
    option(
        parser,
        "--min-probability P",
        "leave out less probable detections (default: 0)",
        number("a probability, 0 to 1", 0, 1),
        default=0.0,
    )
    option(
        parser,
        "--drone-size M",
        "size of every drone, from tip to tip, if known",
        number("a size in metres, 0.05 to 5", 0.05, 5),
    )
    option(parser, "--every N", "look at every Nth frame of a video (default: 1)", positive_count, default=1)
    flag(parser, "--json", "print the result as JSON")
    camera = parser.add_argument_group("the camera of the pictures")
    option(
        camera,
        "--fov DEG",
        "field of view across the longer side, of a lens without distortion; above 100, of a fisheye",
        number(f"an angle in degrees, {MIN_FOV_DEG:g} to {MAX_FOV_DEG:g}", MIN_FOV_DEG, MAX_FOV_DEG),
    )
    option(camera, "--config FILE", "a drone, for its networks and settings and, without --fov, its camera", existing)
    option(camera, "--camera NAME", "the camera of --config, if it has several")


_COLOUR = 1.0
"""Grey levels by which the channels of a picture differ on average; less is no colour."""
_FIGURES = ("probability", "range_m", "range_sigma_m", "size_m")
_HEADS = ("probability", "range, m", "size, m")


@dataclass(frozen=True)
class _Detected:
    """One picture with what was found in it."""

    file: PictureFile
    picture: Picture
    detections: tuple[DetectedDrone, ...]
    proposals: int
    seconds: float
    has_colour: bool
    is_blank: bool


def _run(args: argparse.Namespace) -> int:
    from flockd.ground.datasets.image_files import DatasetError
    from flockd.ground.pictures.copies import Copies
    from flockd.ground.pictures.picture_files import find_pictures
    from flockd.ground.pictures.single_frame import PictureDetector

    if args.force and args.out is None:
        raise UsageError("--force has no meaning without --out; add it")
    drone = loaded(args.config)
    left_out: list[str] = []
    pictures = find_pictures(args.pictures, but_not=args.out, left_out=left_out.append)
    camera = _camera_of_config(args, drone)
    config = _perception(drone, args.drone_size)
    copies = None if args.out is None else Copies(args.out, pictures, overwrite=args.force)
    detected = list(_detected(args, pictures, PictureDetector(config), camera, copies, left_out))
    if left_out and not detected:
        raise DatasetError("\n".join(left_out))
    result = {**_result(detected), "left_out": left_out}
    if not args.json:
        _say_detections(detected, result)
        found = {"detections": sum(len(one.detections) for one in detected)}
        result = found | {
            name: fact for name, fact in result.items() if name not in {"pictures", "drones_of_videos", "left_out"}
        }
    say_facts(args, result)
    if copies is not None:
        complain(f"written: {copies.written} {'copy' if copies.written == 1 else 'copies'} in {args.out}")
    if blank := result["blank"]:
        complain(f"{blank} of {len(detected)} of one colour all over; uncover the lens, or give other pictures")
    if grey := result["without_colour"]:
        complain(
            f"{grey} of {len(detected)} without colour, as thermal and night cameras give them: the networks learnt "
            "from colour pictures and find few drones there; use a colour camera"
        )
    for fault in left_out:
        complain(f"left out: {fault}")
    return ExitCode.CHECK_FAILED if left_out else ExitCode.DONE


def _camera_of_config(args: argparse.Namespace, drone: DroneConfig | None) -> Camera | None:
    """That of --config; None for one of --fov. Raises UsageError where the options do not give one."""
    from flockd.flight.geometry import build_rig

    if drone is None and args.fov is None:
        raise UsageError(
            "the pictures' camera is not known; give its field of view with --fov (a phone's main camera has 65 to "
            "75 degrees, see its data sheet), or a drone with --config"
        )
    if args.camera is not None and (drone is None or args.fov is not None):
        raise UsageError("--camera is one of --config's, in place of --fov; name the drone's file alone")
    if drone is None or args.fov is not None:
        return None
    return build_rig(drone.rig).cameras[camera_of(drone, args.camera, args.config)].camera


def _perception(drone: DroneConfig | None, drone_size_m: float | None) -> PerceptionConfig:
    """A drone's settings, or the defaults. Raises UsageError for a size that cannot be."""
    from pydantic import ValidationError

    from flockd.core.config.perception import PerceptionConfig

    values = {} if drone is None else drone.perception.model_dump()
    if drone_size_m is not None:
        values["drone_size_m"] = drone_size_m
    try:
        return PerceptionConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = "--drone-size, in metres" if first["loc"] == ("drone_size_m",) else f"perception.{first['loc'][0]}"
        raise UsageError(f"{key}: {first['msg']}; correct it") from None


def _detected(
    args: argparse.Namespace,
    pictures: Sequence[PictureFile],
    detector: PictureDetector,
    camera: Camera | None,
    copies: Copies | None,
    left_out: list[str],
) -> Iterator[_Detected]:
    """In order; what cannot be read is skipped, and why appended to ``left_out``."""
    import numpy as np

    from flockd.ground.datasets.image_files import DatasetError
    from flockd.ground.pictures.copies import annotated
    from flockd.ground.pictures.video_tracks import VideoTracker

    count = sum(picture.count(args.every) for picture in pictures)
    done = 0
    with progress("detecting", "pictures") as tell:
        for picture in pictures:
            tracker = VideoTracker() if picture.is_video else None
            with nullcontext() if copies is None else copies.of(picture, args.every) as write:
                try:
                    for one in picture.images(args.every):
                        _check_size(args, one, camera)
                        begin = time.perf_counter()
                        result = detector.detect(one.image, camera, fov_deg=args.fov).at_least(args.min_probability)
                        if tracker is not None:
                            followed = tracker.update(one.time_s, one.image.shape[1::-1], result.detections)
                            result = replace(result, detections=followed)
                        seconds = time.perf_counter() - begin
                        if write is not None:
                            write(annotated(one.image, result))
                        some = one.image[::8, ::8]
                        looks = bool(np.ptp(some, axis=2).mean() >= _COLOUR), bool(np.ptp(some, axis=(0, 1)).max() < 1)
                        yield _Detected(picture, one, result.detections, result.proposals, seconds, *looks)
                        done += 1
                        tell(done, max(done, count))
                except DatasetError as error:
                    left_out.append(str(error))


def _check_size(args: argparse.Namespace, picture: Picture, camera: Camera | None) -> None:
    height, width, _ = picture.image.shape
    if camera is not None and camera.size != (width, height):
        raise UsageError(
            f"{picture.name}: is {width} x {height} pixels, and the camera of {args.config} {camera.size[0]} x "
            f"{camera.size[1]}; give pictures of that camera, or --fov too"
        )


def _result(detected: Sequence[_Detected]) -> dict[str, Any]:
    count = max(len(detected), 1)
    return {
        "images": len(detected),
        "blank": sum(one.is_blank for one in detected),
        "without_colour": sum(not (one.has_colour or one.is_blank) for one in detected),
        "pictures": [
            {
                "file": one.picture.name,
                "detections": [
                    {"box": [round(value, 2) for value in found.box]}
                    | {key: round(getattr(found, key), 4) for key in _FIGURES}
                    | {"kind_known": found.kind_known}
                    | ({} if found.track is None else {"drone": found.track, "seen": found.label > 0})
                    for found in one.detections
                ],
            }
            for one in detected
        ],
        "drones_of_videos": [
            {"file": str(file), "drone": track, "frames": len(seen)}
            | {"first_s": round(seen[0][0], 3), "last_s": round(seen[-1][0], 3)}
            | {key: round(median(getattr(found, key) for _, found in seen), 4) for key in (*_FIGURES, "size_sigma_m")}
            | {"kind_known": 2 * sum(found.kind_known for _, found in seen) > len(seen)}
            for (file, track), seen in _tracks(detected).items()
        ],
        "proposals_per_image": round(sum(one.proposals for one in detected) / count, 2),
        "ms_per_image": round(1000 * sum(one.seconds for one in detected) / count, 2),
    }


def _tracks(detected: Sequence[_Detected]) -> dict[tuple[Path, int], list[tuple[float, DetectedDrone]]]:
    """Of each drone of a video the times and detections of the frames that show it."""
    tracks: dict[tuple[Path, int], list[tuple[float, DetectedDrone]]] = {}
    for one in detected:
        for found in one.detections:
            if found.track is not None and found.label > 0:
                tracks.setdefault((one.file.path, found.track), []).append((one.picture.time_s, found))
    return tracks


def _say_detections(detected: Sequence[_Detected], result: dict[str, Any]) -> None:
    """A row each, its picture named from the folder on that all are in; of a video a row for each drone."""
    common = os.path.commonpath([one.file.path.parent for one in detected]) if detected else "."
    rows, videos = [], []
    for one in detected:
        name = os.path.relpath(one.picture.name, common)
        for found in (found for found in one.detections if found.track is None):
            box = " ".join(f"{value:.0f}" for value in found.box)
            rows.append((name, box, *_cells(vars(found))))
    for one in result["drones_of_videos"]:
        when = f"{one['first_s']:.1f}-{one['last_s']:.1f}"
        name = os.path.relpath(one["file"], common)
        videos.append((name, str(one["drone"]), when, str(one["frames"]), *_cells(one)))
    if rows:
        say_table(("picture", "box, px", *_HEADS), rows)
    if videos:
        say_table(("video", "drone", "seen, s", "frames", *_HEADS), videos)


def _cells(found: dict[str, Any]) -> tuple[str, str, str]:
    """Of `_HEADS`."""
    from flockd.ground.pictures.copies import range_text

    known = found["kind_known"]
    size_m = f"{found['size_m']:.2f} +- {found['size_sigma_m']:.2f}" if known else "kind unknown"
    return f"{found['probability']:.2f}", range_text(found["range_m"], found["range_sigma_m"], known=known), size_m
