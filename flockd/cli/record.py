"""`flockd record`: information about recordings; recovers, cuts and exports them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import add_stretch, opened, refuse_overwriting, stretch
from flockd.cli.output import say_facts, say_result
from flockd.cli.parser import Commands, Parser, commands_of, flag, option
from flockd.core.errors import UsageError

if TYPE_CHECKING:
    from flockd.onboard.recording.reader import Recording


def add(commands: Commands) -> None:
    """Adds the command."""
    examples: tuple[str, ...] = ("flockd record info drone1.mcap", "flockd record recover drone1.mcap")
    commands = commands_of(commands("record", "Inspect, recover, cut and export recordings.", examples))
    examples = ("flockd record info drone1.mcap", "flockd record info --json drone1.mcap")
    _with_recording(commands("info", "Show what a recording contains: duration, gaps, rates.", examples, _info))
    examples = ("flockd record recover drone1.mcap", "flockd record recover drone1.mcap --out whole.mcap")
    description = "Recover a recording that is damaged, or was cut off by a kill or a power loss."
    parser = _with_recording(commands("recover", description, examples, _recover))
    option(parser, "--out FILE", "default: NAME.recovered.mcap", Path)
    examples = ("flockd record cut drone1.mcap --start 20 --end 30 --out turn.mcap",)
    parser = _with_recording(commands("cut", "Copy a part of a recording to a new one.", examples, _cut))
    add_stretch(parser)
    option(parser, "--out FILE", "the new recording", Path, required=True)
    examples = ("flockd record export drone1.mcap --out tables --images",)
    description = "Write a recording's messages as CSV, its images as files."
    parser = _with_recording(commands("export", description, examples, _export))
    option(parser, "--out DIR", "a new or empty folder", Path, required=True)
    flag(parser, "--images", "the images too, in DIR/images/CAMERA")


def _with_recording(parser: Parser) -> Parser:
    option(parser, "RECORDING", "an MCAP file of flockd", Path)
    flag(parser, "--json", "print the result as JSON")
    return parser


def _info(args: argparse.Namespace) -> int:
    from flockd.onboard.recording.reader import recording_info

    return say_facts(args, recording_info(opened(args.recording)))


def _recover(args: argparse.Namespace) -> int:
    from flockd.onboard.recording.editing import recover

    out = args.out or args.recording.with_name(f"{args.recording.stem}.recovered.mcap")
    refuse_overwriting(args, out)
    recording = opened(args.recording)
    return _report_copy(args, recording, out, recover(recording, out))


def _cut(args: argparse.Namespace) -> int:
    from flockd.onboard.recording.editing import cut

    refuse_overwriting(args, args.out)
    recording = opened(args.recording)
    return _report_copy(args, recording, args.out, cut(recording, args.out, *stretch(recording, args)))


def _report_copy(args: argparse.Namespace, recording: Recording, out: Path, steps: int) -> int:
    of = len(recording.contents.steps)
    facts = {"recording": str(args.recording), "out": str(out), "steps": steps, "of_steps": of}
    return say_result(args, facts, f"{out}: {steps} of {of} steps")


def _export(args: argparse.Namespace) -> int:
    from flockd.onboard.recording.export import export_images, export_tables

    if args.out.exists() and (not args.out.is_dir() or any(args.out.iterdir())):
        raise UsageError(f"{args.out}: is not an empty folder; name a new one with --out")
    recording = opened(args.recording)
    args.out.mkdir(parents=True, exist_ok=True)
    tables = export_tables(recording, args.out)
    images = export_images(recording, args.out / "images") if args.images else 0
    facts = {"out": str(args.out), "tables": [path.name for path in tables], "images": images}
    return say_result(args, facts, f"{args.out}: {len(tables)} tables, {images} images")
