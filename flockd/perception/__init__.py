"""Perception: images in, flow, depth and separate drones out; each role an ONNX model behind a manifest."""

from flockd.perception.flow import DisFlow, Flow, OnnxFlow
from flockd.perception.instances import Instance, group_instances
from flockd.perception.roles import OpenDepth, Perception, Picture, RangeEstimate, SceneMaps

__all__ = [
    "DisFlow",
    "Flow",
    "Instance",
    "OnnxFlow",
    "OpenDepth",
    "Perception",
    "Picture",
    "RangeEstimate",
    "SceneMaps",
    "group_instances",
]
