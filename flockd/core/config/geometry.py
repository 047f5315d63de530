"""Motions from paired points, and what feeds them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.core.config.base import Distance, Positive, Section


class GeometryParameters(Section):
    """Motions from paired points, and what feeds them."""

    initial_threshold_m: Distance = 0.01
    """The first threshold of Algorithm 1."""
    min_inlier_ratio: Annotated[float, Field(gt=0, lt=1)] = 0.2
    hypotheses: Annotated[int, Field(ge=1, le=100_000)] = 200
    """IT_MAX of Algorithm 1."""
    max_threshold_m: Distance = 2.0
    """Beyond this the motion counts as not estimated."""
    background_stride_px: Annotated[int, Field(ge=1, le=256)] = 16
    """Between the matches of an image; 16 are the points at which Lucas & Kanade's method makes the flow exact."""
    max_depth_m: Distance = 40.0
    """Background beyond this tells little of the translation and is left out."""
    own_displacement_sigma_m: Positive = 0.02
    """Standard deviation of the own motion that images show over one step, each axis."""
    refine: bool = True
    """Polish the ego-motion by its reprojection error."""
