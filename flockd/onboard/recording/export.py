"""Takes a recording apart: its messages as tables, its images as files."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flockd.onboard.message_json import Json, parsed
from flockd.onboard.recording import foxglove
from flockd.onboard.recording.mcap_file import RecordingError, read_entries
from flockd.onboard.recording.reader import Recording
from flockd.onboard.recording.streams import is_image

Row = dict[str, Any]
Tables = dict[str, list[Row]]
_FILE_NAME = re.compile(r"\w[\w.-]{,100}")
WORDS = ("NaN", "Infinity", "-Infinity")
"""Numbers that JSON has only as text."""


def export_tables(recording: Recording, folder: Path) -> tuple[Path, ...]:
    """Writes a table for each stream of JSON messages, and one for each list within them: a row each message or entry.

    Nested names are joined by dots. Raises RecordingError for messages and names that cannot stand in a table, and
    OSError.
    """
    tables: Tables = {}
    for entry in read_entries(*recording.contents.paths):
        if entry.stream.encoding == "json":
            time = {"log_time_s": entry.time_ns * 1e-9}
            try:
                _add(tables, entry.stream.topic.strip("/"), time, parsed(entry.data))
            except ValueError as error:
                reason = f"a message of {entry.stream.topic[:60]} cannot be read ({error})"
                raise RecordingError(f"{recording.path}: {reason}; use another copy") from error
    try:
        return tuple(_write_csv(folder / f"{_file_name(name)}.csv", rows) for name, rows in tables.items())
    except ValueError as error:
        raise RecordingError(f"{recording.path}: cannot be written as tables ({error}); use another copy") from error


def export_images(recording: Recording, folder: Path) -> int:
    """Writes each image as it is in the recording to `CAMERA/STEP_TIME.png` or `.jpeg`; gives their number."""
    count = 0
    for entry in read_entries(*recording.contents.paths):
        if is_image(entry.stream.topic):
            data, kind = foxglove.image_data(entry.data)
            try:
                camera = folder / _file_name(entry.stream.topic.split("/")[-2])
                kind = _file_name(kind)
            except ValueError as error:
                raise RecordingError(f"{recording.path}: {error}; use another copy") from error
            camera.mkdir(parents=True, exist_ok=True)
            (camera / f"{entry.sequence:06d}_{entry.time_ns * 1e-9:.6f}.{kind}").write_bytes(data)
            count += 1
    return count


def _file_name(name: str) -> str:
    """A name from a recording as that of a file. Raises ValueError for one that may lead out of the folder."""
    if not _FILE_NAME.fullmatch(name):
        raise ValueError(f"it has the name {name[:60]!a}, which is none for a file")
    return name


def _add(tables: Tables, table: str, fixed: Mapping[str, Any], message: Json) -> None:
    """One message as a row, its lists of mappings as rows of tables of their own that begin with the message's time.

    Raises ValueError for what is no mapping.
    """
    if not isinstance(message, Mapping):
        raise ValueError(f"{str(message)[:60]!a} is no mapping")  # noqa: TRY004 - of the file, not of the caller
    row = dict(fixed)
    tables.setdefault(table, []).append(row)
    time = {name: message[name] for name in ("step", "time_s") if name in message} or dict(fixed)
    _fill(tables, table, row, time, "", message)


def _fill(tables: Tables, table: str, row: Row, time: Row, prefix: str, message: Mapping[str, Json]) -> None:
    for key, value in message.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            _fill(tables, table, row, time, f"{name}.", value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for inner in value:
                _add(tables, f"{table}.{name}", time, inner)
        elif isinstance(value, list) and any(isinstance(one, str) and one not in WORDS for one in value):
            row[name] = "; ".join(map(str, value))
        elif isinstance(value, list):
            row.update({f"{name}.{index}": _number(one) for index, one in enumerate(value)})
        else:
            row[name] = _number(value)


def _number(value: Json) -> Json:
    return float(value) if isinstance(value, str) and value in WORDS else value


def _write_csv(path: Path, rows: list[Row]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)
    return path
