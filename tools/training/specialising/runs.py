"""What both ways to specialise share: whose folder it is, how long to train, how it is told."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LEAST_TRAINING = 0.3
"""Least share of the minutes for training, however long rendering took."""
MEASURING = 0.05
"""Share of the minutes that is kept for export and measurement."""


def claim(out: Path, network: str, drone: Mapping[str, object]) -> None:
    """Raises ValueError where the folder holds that network already, or the work on another drone."""
    if (out / f"{network}.yaml").exists():
        raise ValueError(f"--out {out}: holds a {network} network already; name another folder, or delete that one")
    note = out / "work" / "drone.json"
    if note.is_file() and json.loads(note.read_text(encoding="utf-8")) != drone:
        raise ValueError(f"--out {out}: holds the work on another drone or size; name another folder")
    note.parent.mkdir(parents=True, exist_ok=True)
    note.write_text(json.dumps(drone, indent=1), encoding="utf-8")


def training_s(minutes: float, begin: float) -> float:
    """Seconds that are left to train for, of ``minutes`` since ``begin`` (monotonic)."""
    left_s = 60 * minutes * (1 - MEASURING) - (time.monotonic() - begin)
    return max(left_s, 60 * minutes * LEAST_TRAINING)


def command_line(state: Mapping[str, Any]) -> str:
    """What was called, and how long it trained; ``state``: the checkpoint."""
    return (
        f"tools.training.specialise {shlex.join(sys.argv[1:])} ({state['spent'] / 60:.0f} min, {state['step']} steps)"
    )


def table(figures: Mapping[str, Mapping[str, str]]) -> str:
    """One row a figure, one column a network."""
    names = list(next(iter(figures.values())))
    rows = [["", *figures], *[[name, *(column[name] for column in figures.values())] for name in names]]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
