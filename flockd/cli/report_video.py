"""`flockd report --video`: a video of a flight instead of its report."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.output import progress, say, say_json
from flockd.cli.recording_options import opened
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.onboard.recording.reader import Recording
    from flockd.review.flight_log.log import FlightLog
    from flockd.review.flight_log.moments import Moment


def write(args: argparse.Namespace, log: FlightLog, recordings: Sequence[Path]) -> int:
    """Writes the video of ``args.video`` from a flight's log and recordings, or from its folder's key frames."""
    from flockd.review.report.flight_video import check_video_path, write_video

    check_video_path(args.video, force=args.force)
    drone, moments = _of_recordings(args, log, [opened(path) for path in recordings])
    with progress("writing the video", "steps") as tell_progress:
        count = write_video(args.video, log, drone, moments, tell_progress)
    seconds = count * log.metadata.step_s
    if args.json:
        say_json({"video": str(args.video), "frames": count, "seconds": seconds})
    else:
        say(f"{args.video}: {count} frames, {seconds:g} s")
    return ExitCode.DONE


def _of_recordings(
    args: argparse.Namespace, log: FlightLog, recordings: Sequence[Recording]
) -> tuple[int, Iterator[Moment]]:
    """Number of the drone, and its moments."""
    from flockd.review.flight_log.moments import recorded_moments

    if not recordings:
        return _of_key_frames(args, log)
    names = log.metadata.names or [recording.drone for recording in recordings]
    wanted = args.drone or recordings[0].drone
    recording = next((one for one in recordings if one.drone == wanted), None)
    if recording is None or wanted not in names:
        raise UsageError(f"--drone {wanted}: has no recording; name one of {', '.join(r.drone for r in recordings)}")
    return names.index(wanted), recorded_moments(recording)


def _of_key_frames(args: argparse.Namespace, log: FlightLog) -> tuple[int, Iterator[Moment]]:
    from flockd.review.flight_log.key_frames import load_key_frames
    from flockd.review.flight_log.moments import held_moments
    from flockd.review.report.flight_folder import KEY_FRAMES_NAME

    if args.drone is not None:
        raise UsageError(f"--drone {args.drone}: {args.flight} has no recordings; drop it, or fly with --record")
    path = args.flight / KEY_FRAMES_NAME
    frames = load_key_frames(path) if path.is_file() else ()
    return (frames[0].drone if frames else 0), held_moments(log.time_s.tolist(), frames)
