"""Estimation of motions from paired points."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.core.config.base import Distance, Positive, Section


class GeometryParameters(Section):
    """Estimation of motions from paired points."""

    initial_threshold_m: Distance = 0.01
    """The first threshold of Algorithm 1."""
    min_inlier_ratio: Annotated[float, Field(gt=0, lt=1)] = 0.2
    hypotheses: Annotated[int, Field(ge=1, le=100_000)] = 200
    """IT_MAX of Algorithm 1."""
    max_threshold_m: Distance = 2.0
    """If no motion is found up to this threshold, there is no estimate."""
    background_stride_px: Annotated[int, Field(ge=1, le=256)] = 16
    """Distance between matches in an image; at 16, the flow of all of them is refined by Lucas & Kanade's method."""
    max_depth_m: Distance = 40.0
    """Farther background is left out, because it contributes little to the translation."""
    own_displacement_sigma_m: Positive = 0.02
    """Standard deviation of the images' own displacement in a step, each axis."""
    refine: bool = True
    """Whether the ego-motion is refined by minimising its reprojection error."""
