"""Two flights compared: what was flown, and their key figures with the difference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Any

Summary = Mapping[str, Any]

_SETTINGS = ("scenario", "drones", "perception", "flow", "scale", "gated", "seed", "version")
_FIGURES = (
    ("flown", ("duration_s",), "s", 1),
    ("closest two drones", ("flock", "min_distance_m"), "m", 2),
    ("closest after 10 s", ("flock", "min_distance_after_10s_m"), "m", 2),
    ("order at the end", ("flock", "order_tail"), "", 3),
    ("union at the end", ("flock", "union_tail"), "", 2),
    ("known within 10 m", ("neighbours", "recall_within_10m"), "", 3),
    ("false, drone and minute", ("neighbours", "false_per_drone_minute"), "", 2),
    ("own motion x, p95", ("table2", "before", "translation_x_m", "p95"), "m", 4),
    ("own motion y, p95", ("table2", "before", "translation_y_m", "p95"), "m", 4),
    ("distance error, p95", ("table2", "before", "distance_m", "p95"), "m", 4),
    ("times real time", ("realtime_factor",), "", 3),
)
"""Name, keys of the summary, unit, digits."""


@dataclass(frozen=True)
class Row:
    """One line of the comparison; None where a flight has no such value, and where there is no difference to give."""

    name: str
    unit: str
    digits: int | None
    """Decimal digits of a number; None for a word."""
    first: Any
    second: Any
    difference: float | None = None
    """Second less first."""

    @property
    def cells(self) -> tuple[str, str, str]:
        """Both values and their difference, for people."""
        if self.digits is None:
            first, second = ("" if value is None else str(value) for value in (self.first, self.second))
            return first, second, "differs" if first != second else ""
        first, second, difference = (
            "" if value is None else f"{value:{sign}.{self.digits}f} {self.unit}".rstrip()
            for value, sign in ((self.first, ""), (self.second, ""), (self.difference, "+"))
        )
        return first, second, difference


def compare(first: Summary, second: Summary) -> tuple[Row, ...]:
    """Rows for two flights by their summaries, without those that neither has a value for."""
    rows = [Row(name, "", None, first[name], second[name]) for name in _SETTINGS]
    options = dict.fromkeys((*first["settings"], *second["settings"]))
    rows += [Row(f"--{one}", "", None, first["settings"].get(one), second["settings"].get(one)) for one in options]
    for name, keys, unit, digits in _FIGURES:
        one, other = (_value(summary, keys) for summary in (first, second))
        difference = None if one is None or other is None else other - one
        rows.append(Row(name, unit, digits, one, other, difference))
    return tuple(row for row in rows if row.first is not None or row.second is not None)


def _value(summary: Summary, keys: tuple[str, ...]) -> float | None:
    value: Any = reduce(getitem, keys, summary)
    return None if value is None else float(value)
