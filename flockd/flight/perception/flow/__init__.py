"""Optical flow: of whole images by a network or DIS, then of the background and of each drone by themselves."""

from flockd.flight.perception.flow.dis import DisFlow
from flockd.flight.perception.flow.lucas_kanade import grid_flow
from flockd.flight.perception.flow.network import OnnxFlow
from flockd.flight.perception.interface import Flow

__all__ = ["DisFlow", "Flow", "OnnxFlow", "grid_flow"]
