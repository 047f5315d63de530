"""Motions from paired points, and what feeds them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from flockd.core import consistency
from flockd.core.config.base import Distance, Positive, Section


class GeometryParameters(Section):
    """Motions from paired points, and what feeds them."""

    method: Literal["consensus", "paper"] = "consensus"
    """How the own motion is found among false matches: by consensus, which learns the errors' size, or by Algorithm 1,
    as a neighbour's always is."""
    initial_threshold_m: Distance = 0.01
    """Algorithm 1's first."""
    min_inlier_ratio: Annotated[float, Field(gt=0, lt=1)] = 0.2
    hypotheses: Annotated[int, Field(ge=1, le=100_000)] = 200
    """IT_MAX of Algorithm 1."""
    max_threshold_m: Distance = 2.0
    """Beyond this the motion counts as not estimated."""
    background_stride_px: Annotated[int, Field(ge=1, le=256)] = 16
    """Between the matches of an image; 16 are the points at which Lucas & Kanade's method makes the flow exact."""
    max_depth_m: Distance = 40.0
    """Background farther away says little of the translation and is left out."""
    max_acceleration_m_s2: Positive = consistency.EGO_MOTION.limit
    """An ego-motion that would need more than this since the last one is refused, twice in a row at most."""
    max_refused_ego_motions: Annotated[int, Field(ge=0)] = 2
    """In a row: after these, it is the last velocity that is doubted."""
    own_displacement_sigma_m: Positive = 0.02
    """Standard deviation of the own motion over one step, each axis, for tracking."""
    max_drone_pixels: Annotated[int, Field(ge=1)] = 300
    """How many pixels of a neighbour's mask, spread evenly, are matched for its motion."""
    min_drone_pairs: Annotated[int, Field(ge=3)] = 12
    """With fewer point pairs a neighbour's motion is not estimated."""
    neighbour_velocity_caution: Positive = 2.0
    """Factor on the standard deviation of a neighbour's velocity by Eq. 36: it rests on the same ranges as the
    positions do, and so is not independent of them."""
    refine: bool = True
    """Polish the ego-motion by its reprojection error."""
