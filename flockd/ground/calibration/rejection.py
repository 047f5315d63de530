"""Which views or boards do not fit the others, by their residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.core.messages import BoolArray, FloatArray


@dataclass(frozen=True)
class OutlierRejection:
    """Drops what has a large residual and fits again, until nothing has."""

    margin_px: float
    """Above the median's residual, nothing within this is an outlier."""
    factor: float = 2.5
    """Nor is anything within this times the median's."""
    max_dropped: float = 1 / 3
    """Share of all; where more contradict the others, it is not known which are right."""
    max_rounds: int = 5

    def inliers(self, rms_px: FloatArray) -> BoolArray:
        """Mask (n,) of what is kept, of residuals (n,)."""
        median = float(np.median(rms_px))
        kept: BoolArray = rms_px <= max(self.factor * median, median + self.margin_px)
        return kept


def root_mean_square(residuals: FloatArray) -> float:
    """Root of the mean squared length of residuals (n, 2)."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
