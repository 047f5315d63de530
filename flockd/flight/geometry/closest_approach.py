"""How near two points come that move from one place to another, each straight and at an even speed."""

from __future__ import annotations

from typing import Any

import numpy as np

from flockd.core.messages import FloatArray

_LEAST_SQUARE = 1e-300


def share_at_closest(along: Any, squared: Any) -> Any:
    """When two points are closest, as a share of their way, from 0 to 1; of numbers or arrays of them.

    With the offset d of one point from the other as they begin, and w by how much it changes until they end, `along` is
    d . w and `squared` is w . w: |d + s w|^2 is least at s = -(d . w) / (w . w). Where w is 0 it is 0.
    """
    return np.minimum(np.maximum(-along / np.maximum(squared, _LEAST_SQUARE), 0.0), 1.0)


def closest_approach(begin: FloatArray, end: FloatArray) -> FloatArray:
    """(...) m, the least distance of two points whose offset goes straight from `begin` (..., k) to `end` (..., k) m.

    Exact where both fly straight at an even speed. Where their relative acceleration is at most a, it errs by at most
    a T^2 / 8 over a time T.
    """
    way = end - begin
    share = share_at_closest((begin * way).sum(axis=-1), (way * way).sum(axis=-1))
    return np.asarray(np.linalg.norm(begin + share[..., None] * way, axis=-1), dtype=float)
