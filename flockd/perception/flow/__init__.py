"""Optical flow: of whole images by a network or DIS, then of the background and of each drone by themselves."""

from flockd.perception.flow.background import background_flow
from flockd.perception.flow.dis import DisFlow
from flockd.perception.flow.interface import Flow
from flockd.perception.flow.network import OnnxFlow
from flockd.perception.flow.objects import object_flow

__all__ = ["DisFlow", "Flow", "OnnxFlow", "background_flow", "object_flow"]
