"""Facts about a recording, for people and programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flockd.onboard.recording.reader import Recording


def recording_info(recording: Recording) -> dict[str, Any]:
    """What a recording contains, as JSON: flight, duration, models, gaps, damages and the rate of each stream."""
    contents = recording.contents
    return {
        **contents.flight,
        "files": [str(path) for path in contents.paths],
        "bytes": sum(_bytes(path) for path in contents.paths),
        "finished": contents.finished,
        "steps": len(contents.steps),
        "start_s": recording.start_s,
        "duration_s": recording.duration_s,
        "lost": contents.lost,
        "models": dict(contents.models),
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


def _bytes(path: Path) -> int:
    """Of a file, or of all in a bag's folder."""
    return sum(one.stat().st_size for one in path.iterdir()) if path.is_dir() else path.stat().st_size
