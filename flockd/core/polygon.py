"""Whether a place is within a polygon."""

from __future__ import annotations

from collections.abc import Sequence


def is_inside(corners: Sequence[tuple[float, float]], north_m: float, east_m: float) -> bool:
    """Whether a ray to the east crosses the outline through the corners, (north, east), an odd number of times."""
    crossed = 0
    for (n1, e1), (n2, e2) in zip(corners, (*corners[1:], corners[0]), strict=True):
        crossed += (n1 > north_m) != (n2 > north_m) and east_m < e1 + (e2 - e1) * (north_m - n1) / (n2 - n1)
    return crossed % 2 == 1
