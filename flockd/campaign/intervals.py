"""Confidence intervals of what is measured in several flights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit


class Interval(NamedTuple):
    """A mean, and between which values the true one lies with the asked confidence."""

    mean: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Half the width of the wider side."""
        return max(self.high - self.mean, self.mean - self.low)


def mean_interval(values: Sequence[float], confidence: float = 0.95, *, is_share: bool = False) -> Interval | None:
    """By Student's t; of values that are 0 or 1 (``is_share``) by Wilson's score. None where there is none.

    One value tells nothing of how much they differ. E. B. Wilson, "Probable inference, the law of succession, and
    statistical inference", 1927.
    """
    n = len(values)
    if n < (1 if is_share else 2):
        return None
    mean = float(np.mean(values))
    if is_share:
        z = float(ndtri((1 + confidence) / 2))
        middle = (mean + z * z / (2 * n)) / (1 + z * z / n)
        reach = z / (1 + z * z / n) * math.sqrt(mean * (1 - mean) / n + z * z / (4 * n * n))
        return Interval(mean, max(middle - reach, 0.0), min(middle + reach, 1.0))
    reach = float(stdtrit(n - 1, (1 + confidence) / 2)) * float(np.std(values, ddof=1)) / math.sqrt(n)
    return Interval(mean, mean - reach, mean + reach)
