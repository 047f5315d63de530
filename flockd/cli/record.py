"""`flockd record`: looks into recordings, mends them, cuts them and takes them apart."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.output import progress, say, say_json
from flockd.cli.parser import Commands, Parser, add_commands, positive_number
from flockd.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.config import DroneConfig
    from flockd.recording.reader import Recording


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = ("flockd record info drone1.mcap", "flockd record recover drone1.mcap")
    parser = commands("record", "Look into recordings, mend, cut and export them.", examples)
    add_commands(parser, (_add_info, _add_recover, _add_cut, _add_export))


def _add_info(commands: Commands) -> None:
    examples = ("flockd record info drone1.mcap", "flockd record info --json drone1.mcap")
    parser = _with_recording(commands("info", "Tell what is in a recording: how long, gaps, rates.", examples))
    parser.set_defaults(run=_info)


def _add_recover(commands: Commands) -> None:
    examples = ("flockd record recover drone1.mcap", "flockd record recover drone1.mcap --out mended.mcap")
    description = "Make a whole recording of one that a kill or a loss of power cut off, or that is damaged."
    parser = _with_recording(commands("recover", description, examples))
    parser.add_argument("--out", metavar="FILE", type=Path, help="default: NAME.recovered.mcap")
    parser.set_defaults(run=_recover)


def _add_cut(commands: Commands) -> None:
    examples = ("flockd record cut drone1.mcap --start 20 --end 30 --out turn.mcap",)
    parser = _with_recording(commands("cut", "Make a recording of a stretch of another.", examples))
    add_stretch(parser)
    parser.add_argument("--out", metavar="FILE", type=Path, required=True)
    parser.set_defaults(run=_cut)


def _add_export(commands: Commands) -> None:
    examples = (
        "flockd record export drone1.mcap --out tables",
        "flockd record export drone1.mcap --out tables --format parquet --images",
    )
    parser = _with_recording(
        commands("export", "Write a recording's messages as tables, its images as files.", examples)
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="a new or empty folder")
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv", help="of the tables (default: csv)")
    parser.add_argument("--images", action="store_true", help="the images too, in DIR/images/CAMERA")
    parser.set_defaults(run=_export)


def _with_recording(parser: Parser) -> Parser:
    parser.add_argument("recording", metavar="RECORDING", type=Path)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    return parser


def add_stretch(parser: Parser) -> None:
    """Adds --start and --end, in seconds from the recording's first step."""
    parser.add_argument("--start", metavar="S", type=_seconds, default=0.0, help="seconds from the first step")
    parser.add_argument("--end", metavar="S", type=positive_number, help="seconds from the first step")


def _seconds(text: str) -> float:
    return 0.0 if text in {"0", "0.0"} else positive_number(text)


def stretch(recording: Recording, args: argparse.Namespace) -> tuple[float, float]:
    """From when to when, on the recording's clock, --start and --end ask for. Raises UsageError for nothing."""
    rounding_s = 1e-6
    end_s = recording.duration_s if args.end is None else args.end
    begin, end = recording.start_s + args.start - rounding_s, recording.start_s + end_s + rounding_s
    if not any(begin <= time_s <= end for _, time_s in recording.contents.steps):
        raise UsageError(
            f"{recording.path}: has no step from {args.start:g} s to {end_s:g} s, as it is "
            f"{recording.duration_s:g} s long; choose --start and --end within it"
        )
    return begin, end


def opened(path: Path) -> Recording:
    """The recording, checked as a whole, with a progress bar. Raises RecordingError."""
    from flockd.recording.reader import Recording

    with progress("checking", "bytes") as tell:
        return Recording(path, tell)


def models_of(config: DroneConfig) -> dict[str, str]:
    """SHA-256 of each model that a configuration uses, by name. Raises ModelError."""
    from flockd.inference import load_manifest, manifests_of

    manifests = [load_manifest(path)[0] for path in sorted(manifests_of(config.perception))]
    return {manifest.name: manifest.sha256 for manifest in manifests}


def refuse_existing(path: Path, option: str = "--out") -> None:
    """Raises UsageError when there is something at `path`, or no folder for it."""
    if path.exists():
        raise UsageError(f"{path}: exists; name a new file with {option}")
    if not path.parent.is_dir():
        raise UsageError(f"{path.parent}: is no folder; make it first, or name another file with {option}")


def _info(args: argparse.Namespace) -> int:
    recording = opened(args.recording)
    facts = _facts(recording)
    if args.json:
        say_json(facts)
        return ExitCode.DONE
    from rich.console import Console
    from rich.table import Table

    for name in ("drone", "began", "version", "steps", "duration_s", "bytes", "images", "finished", "lost"):
        say(f"{name:12}{facts[name]}")
    for name, sha256 in facts["models"].items():
        say(f"{'model':12}{name} {sha256[:12]}")
    for note in facts["migrations"]:
        say(f"{'migration':12}{note}")
    for gap in facts["gaps"]:
        say(f"{'gap':12}steps {gap['first_step']} to {gap['last_step']} are missing")
    for damage in facts["damages"]:
        say(f"{'damage':12}{damage['file']} at byte {damage['byte']}: {damage['reason']}")
    table = Table("stream", "schema", "messages", "rate", box=None, pad_edge=False)
    for stream in facts["streams"]:
        rate = "" if stream["rate_hz"] is None else f"{stream['rate_hz']:.2f} Hz"
        table.add_row(stream["topic"], stream["schema"], f"{stream['messages']}", rate)
    Console(markup=False, highlight=False).print(table)
    return ExitCode.DONE


def _facts(recording: Recording) -> dict[str, Any]:
    contents = recording.contents
    return {
        **contents.flight,
        "files": [str(path) for path in contents.paths],
        "bytes": sum(path.stat().st_size for path in contents.paths),
        "finished": contents.finished,
        "steps": len(contents.steps),
        "start_s": recording.start_s,
        "duration_s": recording.duration_s,
        "lost": contents.lost,
        "models": dict(contents.models),
        "migrations": list(recording.migrations),
        "gaps": [{"first_step": first, "last_step": last} for first, last in contents.gaps],
        "damages": [
            {"file": str(path), "byte": damage.offset, "reason": damage.reason} for path, damage in contents.damages
        ],
        "streams": [
            {
                "topic": stream.topic,
                "schema": stream.schema,
                "messages": stream.messages,
                "rate_hz": stream.rate_hz,
                "bytes": stream.bytes,
            }
            for stream in contents.streams.values()
        ],
    }


def _recover(args: argparse.Namespace) -> int:
    from flockd.recording.editing import recover

    out = args.out or args.recording.with_name(f"{args.recording.stem}.recovered.mcap")
    refuse_existing(out)
    recording = opened(args.recording)
    return _told(args, recording, out, recover(recording, out))


def _cut(args: argparse.Namespace) -> int:
    from flockd.recording.editing import cut

    refuse_existing(args.out)
    recording = opened(args.recording)
    return _told(args, recording, args.out, cut(recording, args.out, *stretch(recording, args)))


def _told(args: argparse.Namespace, recording: Recording, out: Path, steps: int) -> int:
    of = len(recording.contents.steps)
    if args.json:
        say_json({"recording": str(args.recording), "out": str(out), "steps": steps, "of_steps": of})
    else:
        say(f"{out}: {steps} of {of} steps")
    return ExitCode.DONE


def _export(args: argparse.Namespace) -> int:
    from flockd.recording.export import export_images, export_tables

    if args.out.exists() and (not args.out.is_dir() or any(args.out.iterdir())):
        raise UsageError(f"{args.out}: is not an empty folder; name a new one with --out")
    if args.format == "parquet":
        import pyarrow  # noqa: F401 - so that nothing is half-written when the extra is missing
    recording = opened(args.recording)
    args.out.mkdir(parents=True, exist_ok=True)
    tables = export_tables(recording, args.out, args.format)
    images = export_images(recording, args.out / "images") if args.images else 0
    if args.json:
        say_json({"out": str(args.out), "tables": [path.name for path in tables], "images": images})
    else:
        say(f"{args.out}: {len(tables)} tables, {images} images")
    return ExitCode.DONE
