"""`flockd view`: a recording, or the flock of a whole flight, in Rerun."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from flockd.cli.output import complain, progress, say, say_json
from flockd.cli.parser import Commands
from flockd.cli.recording_options import add_stretch, opened, refuse_existing, require, stretch
from flockd.core.errors import ExitCode, UnavailableError, UsageError


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd view drone1.mcap",
        "flockd view drone1.mcap --start 60 --end 70",
        "flockd view drone1.mcap --save drone1.rrd --json",
        "flockd view drone1.mcap --as-recorded",
        "flockd view out/short/recordings --save flock.rrd",
    )
    description = (
        "Show a recording or a flock in Rerun: images, drones, depth, point pairs, neighbours, commands and curves."
    )
    parser = commands("view", description, examples)
    parser.add_argument(
        "recording", metavar="RECORDING", type=Path, help="a recording, or a folder of one flight's: shows the flock"
    )
    add_stretch(parser)
    parser.add_argument("--save", metavar="FILE", type=Path, help="write a file for Rerun (.rrd) and open nothing")
    parser.add_argument(
        "--as-recorded",
        action="store_true",
        help="show only what was recorded; drones in the images, depth and point pairs would be computed again",
    )
    parser.add_argument("--json", action="store_true", help="with --save: print the result as JSON")
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    require(args.recording)
    import flockd.review.view.rerun_file  # noqa: F401 - so that nothing is computed when the extra is missing

    if args.json and args.save is None:
        raise UsageError("--json has no meaning without --save; add it")
    if args.save is not None:
        refuse_existing(args.save, "--save")
        _tell(args, _write(args, args.save))
        return ExitCode.DONE
    _check_screen()
    from flockd.review.view.rerun_file import open_viewer

    with tempfile.TemporaryDirectory(prefix="flockd-") as folder:
        path = Path(folder) / f"{args.recording.resolve().stem}.rrd"
        _tell(args, _write(args, path))
        code = open_viewer(path)
    if code != 0:
        raise UnavailableError(f"Rerun's viewer ended with code {code}; write a file for another computer with --save")
    return ExitCode.DONE


def _check_screen() -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UnavailableError("there is no screen here to open Rerun on; write a file for it with --save FILE.rrd")


def _write(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    if args.recording.is_dir():
        return _write_flock(args, path)
    from flockd.onboard.recording.editing import written_whole
    from flockd.review.replay.fidelity import damage_warnings, replay_warnings
    from flockd.review.view.rerun_file import RerunFile
    from flockd.review.view.scene import Scenes, texts

    recording = opened(args.recording)
    start_s, end_s = stretch(recording, args)
    fly_again = not args.as_recorded
    for warning in (
        *damage_warnings(recording),
        *(replay_warnings(recording, recording.config, start_s) if fly_again else ()),
    ):
        complain(warning)
    scenes = Scenes(recording, fly_again=fly_again)
    total = sum(start_s <= time_s <= end_s for _, time_s in recording.contents.steps)
    shown = 0
    with written_whole(path) as draft, closing(RerunFile(draft, recording.drone, scenes.rig)) as file:
        with progress("flying again" if fly_again else "reading", "steps") as tell:
            for moment in scenes.moments(start_s, end_s):
                file.show(moment)
                shown += 1
                tell(shown, total)
        for time_s, text in texts(recording, start_s, end_s):
            file.say(time_s, text)
    return {
        "recording": str(args.recording),
        "file": str(path),
        "drone": recording.drone,
        "steps": shown,
        "flown_again": scenes.compared,
        "as_recorded": scenes.equal,
    }


def _write_flock(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """All drones of one flight, as recorded, by the truth in their recordings."""
    from flockd.onboard.recording import RecordingError
    from flockd.onboard.recording.editing import written_whole
    from flockd.review.flight_log.from_recordings import recordings_in
    from flockd.review.replay.fidelity import damage_warnings
    from flockd.review.view.flock_file import FlockFile

    folder: Path = args.recording
    if not recordings_in(folder) and (folder / "recordings").is_dir():
        folder = folder / "recordings"  # of a flight's own folder
    recordings = [opened(one) for one in recordings_in(folder)]
    if not recordings:
        raise UsageError(f"{folder}: holds no recordings; name another folder, or fly with --record")
    for recording in recordings:
        if not recording.has_truth:
            raise RecordingError(
                f"{recording.path}: holds no truth, and without it the drones of a flight cannot be placed in one "
                "view; name one recording"
            )
        for warning in damage_warnings(recording):
            complain(warning)
    stretches = [stretch(recording, args) for recording in recordings]
    cameras = {one.drone: [camera.name for camera in one.config.rig.cameras] for one in recordings}
    shown = 0
    total = sum(
        start_s <= time_s <= end_s
        for recording, (start_s, end_s) in zip(recordings, stretches, strict=True)
        for _, time_s in recording.contents.steps
    )
    with (
        written_whole(path) as draft,
        closing(FlockFile(draft, folder.resolve().name, cameras)) as file,
        progress("reading", "steps") as tell,
    ):
        for recording, (start_s, end_s) in zip(recordings, stretches, strict=True):
            for step in recording.steps(start_s, end_s):
                file.show(recording.drone, step)
                shown += 1
                tell(shown, total)
    return {
        "recording": str(args.recording),
        "file": str(path),
        "drone": ", ".join(one.drone for one in recordings),
        "steps": shown,
        "flown_again": 0,
        "as_recorded": 0,
    }


def _tell(args: argparse.Namespace, result: Mapping[str, Any]) -> None:
    if args.json:
        say_json(result)
        return
    say(f"{result['drone']}: {result['steps']} steps")
    if result["flown_again"]:
        say("drones in the images, depth and point pairs were computed again from the recorded images")
        if not args.start:  # later a pilot without memory cannot be equal
            say(f"as recorded came out: {result['as_recorded']} of {result['flown_again']} steps")
    else:
        say("without drones in the images, depth and point pairs, which no recording holds")
    if args.save is not None:
        say(f"file: {args.save}")
