"""`flockd calibrate drone`: a drone's size from photographs of it at measured distances."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.calibrate_options import refuse_overwriting
from flockd.cli.output import progress, say, say_json
from flockd.cli.parser import Commands, positive_count, positive_number
from flockd.cli.picture_options import PictureCameras, add_picture_options, perception_of
from flockd.cli.recording_options import opened
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.core.messages import UInt8Array
    from flockd.flight.geometry import Camera
    from flockd.ground.calibration.drone_size import DroneSize, Photograph

    Taken = tuple[str, float, UInt8Array, Camera]
    """A picture's name, its distance in metres, the image and its camera."""

RECORDING = ".mcap"
NOTES = """\
A distance is from the lens to the drone's middle. Photograph the drone alone, from several sides and at two or more
distances, at least 30 pixels wide. Of a recording, the drone stays at that distance all the time."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd calibrate drone --distance 3.0 a.jpg b.jpg --distance 5.0 c.jpg d.jpg --fov 70",
        "flockd calibrate drone distances.yaml --config my_drone.yaml --camera front",
        "flockd calibrate drone --distance 4.0 hover.mcap --every 10",
    )
    parser = commands("drone", "Measure the drones' size, as the networks see it.", examples, NOTES)
    parser.add_argument("source", metavar="DISTANCES", nargs="?", type=Path, help="YAML: `pictures`, file, distance_m")
    parser.add_argument(
        "--distance",
        metavar=("M", "PICTURE"),
        nargs="+",
        action="append",
        default=[],
        help="metres, and the images, folders, videos or recordings taken there; may be given again",
    )
    parser.add_argument("--every", metavar="N", type=positive_count, default=1, help="take every Nth frame (1)")
    parser.add_argument("--out", metavar="FILE", type=Path, help="where the result goes (drone_size.yaml)")
    parser.add_argument("--force", action="store_true", help="overwrite what is there")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    add_picture_options(parser)
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    from flockd.ground.calibration.drone_size import fit_size
    from flockd.onboard.recording.editing import written_whole

    out = args.out or Path("drone_size.yaml")
    refuse_overwriting(args, out)
    size = fit_size(list(_photographs(args, _distances(args))))
    source = str(args.source) if args.source else ", ".join(f"{one[0]} m: {len(one) - 1}" for one in args.distance)
    with written_whole(out) as draft:
        draft.write_text(size.fragment(source), encoding="utf-8")
    if args.json:
        say_json({**size.as_json(), "out": str(out)})
    else:
        _say(size, out)
    return ExitCode.DONE


def _distances(args: argparse.Namespace) -> list[tuple[float, Path]]:
    from flockd.ground.calibration.distances import MAX_DISTANCE_M, read_distances

    if (args.source is None) == (not args.distance):
        raise UsageError("name the pictures and their distances, either in a YAML file or with --distance M PICTURE...")
    if args.source is not None:
        return read_distances(args.source)
    listed = []
    for text, *pictures in args.distance:
        try:
            distance_m = positive_number(text)
        except argparse.ArgumentTypeError as error:
            raise UsageError(f"--distance: {error}; write metres, then the pictures taken there") from None
        if distance_m > MAX_DISTANCE_M:
            raise UsageError(f"--distance: {text} is more than {MAX_DISTANCE_M:g} m; write metres")
        if not pictures:
            raise UsageError(f"--distance {text}: names no picture; write the pictures taken there after the metres")
        listed += [(distance_m, Path(picture)) for picture in pictures]
    return listed


def _photographs(args: argparse.Namespace, distances: Sequence[tuple[float, Path]]) -> Iterator[Photograph]:
    """With what is detected in each picture, of unknown size."""
    from flockd.ground.calibration.drone_size import Photograph, SizeCandidate
    from flockd.ground.pictures import PictureDetector

    recordings = [path for _, path in distances if path.suffix == RECORDING]
    cameras = None
    if args.config is not None or args.fov is not None or len(recordings) < len(distances):
        cameras = PictureCameras(args)
    detector = PictureDetector(perception_of(args, None if cameras is None else cameras.config, drone_size_m=None))
    with progress("detecting", "pictures") as tell:
        for number, (name, distance_m, image, camera) in enumerate(_taken(args, distances, cameras), start=1):
            found = detector.detect(image, camera).detections
            tell(number, max(number, len(distances)))
            yield Photograph(
                name,
                distance_m,
                tuple(
                    SizeCandidate(
                        distance_m * one.size_m / one.range_m, one.range_sigma_m / one.range_m, one.probability
                    )
                    for one in found
                ),
            )


def _taken(
    args: argparse.Namespace, distances: Sequence[tuple[float, Path]], cameras: PictureCameras | None
) -> Iterator[Taken]:
    from flockd.ground.pictures import find_pictures

    for distance_m, path in distances:
        if path.suffix == RECORDING:
            yield from _of_recording(args, distance_m, path, None if cameras is None else cameras.config)
            continue
        assert cameras is not None
        for picture in find_pictures([path]):
            for name, image in picture.images(args.every):
                yield name, distance_m, image, cameras.of(name, (image.shape[1], image.shape[0]))


def _of_recording(
    args: argparse.Namespace, distance_m: float, path: Path, config: DroneConfig | None
) -> Iterator[Taken]:
    """Frames of every camera, or of --camera."""
    from flockd.flight.geometry import build_rig

    recording = opened(path)
    rig = build_rig((config or recording.config).rig)
    if args.camera is not None and args.camera not in rig.cameras:
        raise UsageError(f"{path}: has no camera {args.camera!r}; choose --camera from {', '.join(rig.cameras)}")
    for step in recording.steps():
        if step.number % args.every:
            continue
        for name, frame in step.frames.frames.items():
            if name in rig.cameras and args.camera in {None, name}:
                label = f"{path} {step.frames.time_s - recording.start_s:.2f} s, {name}"
                yield label, distance_m, frame.image, rig.cameras[name].camera


def _say(size: DroneSize, out: Path) -> None:
    for one in size.pictures:
        residual = one.residual(size.size_m)
        note = "" if one.used else "; dropped: it does not fit the others"
        say(
            f"{one.name}: {one.distance_m:g} m, size {one.size_m:.3f} m, "
            f"range {100 * residual:+.1f} % ({residual * one.distance_m:+.2f} m){note}"
        )
    if size.missed:
        say(f"nothing detected: {', '.join(size.missed)}")
    used = sum(one.used for one in size.pictures)
    say(f"drone_size_m: {size.size_m:.4f} +- {size.sigma_m:.4f} m, from {used} pictures")
    say(f"written: {out}; copy its keys to perception in your drone's file, then run flockd config check on that")
