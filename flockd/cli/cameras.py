"""`flockd cameras`: what is plugged in, what it gives, and the configuration that names it."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.config import write_checked
from flockd.cli.options import refuse_overwriting
from flockd.cli.output import complain, say_facts
from flockd.cli.parser import Commands, duration, flag, option, size
from flockd.core.errors import ExitCode, UnavailableError, UsageError

if TYPE_CHECKING:
    from flockd.ground.cameras.listing import FoundCamera, Mode
    from flockd.ground.cameras.watching import Watched

SECONDS = 4.0
NONE_FOUND = (
    "no camera is plugged in; check cable and port, for a CSI camera also the overlay or device tree of its board, "
    "and install gstreamer1.0-plugins-base-apps so that those of libcamera are found"
)


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd cameras",
        "flockd cameras --picture pictures",
        "flockd cameras --size 1280x720 --names front back --write cameras.yaml",
        "flockd cameras --turn-deg 90 --write cameras.yaml",
    )
    description = "List the cameras of this computer, measure their images, and write their configuration."
    parser = commands("cameras", description, examples, _run)
    option(parser, "--picture FOLDER", "run all cameras, measure their images, and save one of each", Path)
    option(parser, "--seconds S", f"measure for S seconds (default: {SECONDS:g})", duration, default=SECONDS)
    option(parser, "--size WxH", "image size, or the nearest there is (default: 640x480)", size, default=(640, 480))
    option(parser, "--write FILE", "write the configuration's sections `rig` and `source` for these cameras", Path)
    told = "turn their images clockwise until they are upright: 90 for cameras on their sides, tops to the right"
    option(parser, "--turn-deg", told, int, choices=(0, 90, 180, 270), default=0)
    option(parser, "--names NAME", "names of the cameras in the rig, in the order of the list", nargs="+")
    flag(parser, "--force", "overwrite the file if it exists")
    flag(parser, "--json", "print JSON")


def _run(args: argparse.Namespace) -> int:
    from flockd.ground.cameras.listing import Computer, list_cameras

    refuse_overwriting(args, args.write)
    computer = Computer()
    found = list_cameras(computer)
    if not found:
        raise UnavailableError(NONE_FOUND)
    modes = [camera.best_mode(args.size) for camera in found]
    usable = [(camera, mode) for camera, mode in zip(found, modes, strict=True) if mode is not None]
    measured: dict[str, Watched] = {}
    if args.picture is not None:
        from flockd.ground.cameras.watching import measure

        complain(f"measuring {len(usable)} cameras for {args.seconds:g} s")
        rows = measure(usable, args.seconds, computer.kernel)
        measured = {camera.place: row for (camera, _), row in zip(usable, rows, strict=True)}
    pictures = _save_pictures(args.picture, found, measured) if args.picture is not None else {}
    facts = [_facts(camera, mode, measured, pictures) for camera, mode in zip(found, modes, strict=True)]
    if not args.json:
        facts = [{**fact, **_offers(camera, mode)} for fact, camera, mode in zip(facts, found, modes, strict=True)]
    say_facts(args, facts)
    if args.write is not None:
        _write(args.write, usable, args.names, args.turn_deg)
    faulty = any(camera.fault for camera in found) or any(row.fault for row in measured.values())
    return ExitCode.CHECK_FAILED if faulty else ExitCode.DONE


def _write(file: Path, usable: Sequence[tuple[FoundCamera, Mode]], names: Sequence[str] | None, turn_deg: int) -> None:
    from flockd.ground.cameras.listing import camera_names, sections_text

    if not usable:
        raise UsageError(f"{file} was not written, as no camera can be used; see what is wrong with each above")
    names = names or camera_names(len(usable))
    if len(set(names)) != len(usable) or len(names) != len(usable):
        raise UsageError(f"--names gives {len(set(names))} names for {len(usable)} cameras; give each its own")
    write_checked(file, sections_text(dict(zip(names, usable, strict=True)), turn_deg))


def _save_pictures(folder: Path, found: Sequence[FoundCamera], measured: Mapping[str, Watched]) -> dict[str, Path]:
    """By the camera's place."""
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    saved = {}
    for number, camera in enumerate(found):
        row = measured.get(camera.place)
        if row is not None and row.image is not None:
            saved[camera.place] = folder / f"camera{number}.png"
            cv2.imwrite(str(saved[camera.place]), cv2.cvtColor(row.image, cv2.COLOR_RGB2BGR))
    return saved


def _offers(camera: FoundCamera, chosen: Mode | None) -> dict[str, object]:
    """Its modes for people, a line a format, and the one that is used."""
    by_format: dict[str, list[str]] = {}
    for mode in camera.modes:
        by_format.setdefault(mode.pixel_format, []).append(_told(mode))
    return {
        "modes": {name: "; ".join(told) for name, told in by_format.items()},
        "used": chosen and f"{chosen.pixel_format} {_told(chosen)}",
    }


def _told(mode: Mode) -> str:
    size, rates = "x".join(map(str, mode.size)), ", ".join(f"{rate:g}" for rate in mode.rates_hz)
    return f"{size} at {rates}" if rates else size


def _facts(
    camera: FoundCamera, chosen: Mode | None, measured: Mapping[str, Watched], pictures: Mapping[str, Path]
) -> dict[str, object]:
    def mode_json(mode: Mode) -> dict[str, object]:
        return {"pixel_format": mode.pixel_format, "size_px": list(mode.size), "rates_hz": list(mode.rates_hz)}

    shown: dict[str, object] = {
        "name": camera.name,
        "node": camera.node or None,
        "device": camera.device or None,
        "element": camera.element or None,
        "fault": camera.fault,
        "modes": [mode_json(mode) for mode in camera.modes],
        "used": None if chosen is None else mode_json(chosen),
        "controls": {control.name: [control.low, control.high] for control in camera.controls},
    }
    row = measured.get(camera.place)
    if row is not None:
        from flockd.ground.cameras.watching import edge_width_px

        edge_px = math.nan if row.image is None else edge_width_px(row.image)
        shown["measured"] = {
            "fault": row.fault,
            "rate_hz": row.rate_hz,
            "jitter_s": row.jitter_s(),
            "lost": row.lost,
            "refused": dict(row.refused),
            "edge_width_px": None if math.isnan(edge_px) else edge_px,
            "mean_grey": None if row.image is None else float(row.image.mean()),
        }
        shown["picture"] = str(pictures[camera.place]) if camera.place in pictures else None
    return shown
