"""Text tables: numbers in columns, with comments."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flockd.core.messages import FloatArray
from flockd.ground.datasets.errors import DatasetError

MAX_TABLE_BYTES = 1 << 28
"""Hours of poses at 200 Hz."""


def read_lines(file: Path) -> list[tuple[int, str]]:
    """Line number from 1 and text of each line that is neither empty nor a comment. Raises DatasetError."""
    if file.exists() and not file.is_file():
        raise DatasetError(f"{file}: is not an ordinary file; restore it")
    if file.exists() and file.stat().st_size > MAX_TABLE_BYTES:
        raise DatasetError(f"{file}: is larger than {MAX_TABLE_BYTES >> 20} MiB, which no table is; restore it")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise DatasetError(f"{file}: cannot be read ({reason}); put it there") from None
    lines = ((number, line.rstrip()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, line) for number, line in lines if line and not line.lstrip().startswith("#")]


def read_rows(file: Path, *, columns: int, what: str) -> FloatArray:
    """(n, columns) numbers, between blanks or commas. Raises DatasetError where a line has others, or none is."""
    rows = [_row(file, number, line, columns, what) for number, line in read_lines(file)]
    if not rows:
        raise DatasetError(f"{file}: is empty; it needs {what}")
    return np.array(rows, np.float64)


def _row(file: Path, number: int, line: str, columns: int, what: str) -> list[float]:
    words = line.replace(",", " ").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != columns or not np.isfinite(values).all():
        raise DatasetError(f"{file}:{number}: does not fit; it needs {what}")
    return values
