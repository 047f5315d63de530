"""Algorithm 1 and what feeds it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.config.base import Positive, Section


class GeometryParameters(Section):
    """Algorithm 1 and what feeds it."""

    initial_threshold_m: Positive = 0.01
    min_inlier_ratio: Annotated[float, Field(gt=0, lt=1)] = 0.2
    hypotheses: Annotated[int, Field(ge=1, le=100_000)] = 200
    """IT_MAX of Algorithm 1."""
    max_threshold_m: Positive = 2.0
    """Beyond this the motion counts as not estimated."""
    background_stride_px: Annotated[int, Field(ge=1, le=256)] = 16
    max_depth_m: Positive = 40.0
    """Background farther away says little of the translation and is left out."""
    max_acceleration_m_s2: Positive = 6.0
    """An ego-motion that would need more than this since the last one is refused, twice in a row at most."""
    refine: bool = True
    """Polish the ego-motion by its reprojection error after Algorithm 1."""
