"""Angles are angles modulo a turn."""

from __future__ import annotations

import math


def wrapped(angle_rad: float) -> float:
    """The same direction in (-pi, pi]; an angle in there stays as it is. NaN where it is not finite."""
    if not math.isfinite(angle_rad):
        return math.nan
    turned_rad = math.remainder(angle_rad, math.tau)
    return turned_rad if turned_rad > -math.pi else math.pi
