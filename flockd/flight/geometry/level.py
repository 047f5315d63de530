"""Level vectors, north and east: their length, and from where on they have a direction."""

from __future__ import annotations

import math

from flockd.core.messages import FloatArray

SAME_SPOT_M = 0.1
"""A neighbour at a smaller level range is above or below, in no direction: cameras do not measure one that well."""
_ROUNDING = 2.0**-50
"""Share by which a length may be off after scaling: two roundings in the product and two in the lengths."""


def limit_norm(vector: FloatArray, maximum: float) -> FloatArray:
    """The vector (2,) itself if it is no longer than `maximum`, else one in its direction of that length at most.

    `math.hypot` of the result is never above `maximum`, so that what is limited twice passes the second time as it is.
    """
    length = math.hypot(*vector)
    if length <= maximum:
        return vector
    limited = vector * (maximum / length)
    return limited if math.hypot(*limited) <= maximum else limited * (1 - _ROUNDING)
