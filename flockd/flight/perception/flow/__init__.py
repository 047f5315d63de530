"""Optical flow: dense, by a network or DIS, then refined on a grid of points."""

from flockd.flight.perception.flow.dense import DisFlow, OnnxFlow
from flockd.flight.perception.flow.lucas_kanade import grid_flow

__all__ = ["DisFlow", "OnnxFlow", "grid_flow"]
