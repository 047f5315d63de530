"""Horizontal vectors, north and east: limits of their length, and the length below which they have no direction."""

from __future__ import annotations

import math

from flockd.core.messages import FloatArray

SAME_SPOT_M = 0.1
"""A neighbour at a smaller horizontal range has no direction: cameras do not measure such a bearing."""
_ROUNDING = 2.0**-50
"""Relative rounding error of a scaled length: two roundings in the product and two in the lengths."""


def limit_norm(vector: FloatArray, maximum: float) -> FloatArray:
    """The vector (2,) itself if it is no longer than `maximum`, else one in its direction of at most that length.

    `math.hypot` of the result is never above `maximum`, so that limiting it again changes nothing.
    """
    length = math.hypot(*vector)
    if length <= maximum:
        return vector
    limited = vector * (maximum / length)
    return limited if math.hypot(*limited) <= maximum else limited * (1 - _ROUNDING)
