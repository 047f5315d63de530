"""Perception: frames in, an observation out; each role of it an ONNX model behind a manifest."""

from flockd.perception.detection.instances import Instance, group_instances
from flockd.perception.flow import DisFlow, Flow, OnnxFlow
from flockd.perception.maps import Crop, OpenDepth, RangeEstimate, SceneMaps
from flockd.perception.networks import Networks, OnnxNetworks
from flockd.perception.observation import CameraObservation, Observation
from flockd.perception.pipeline import Perception, load_networks

__all__ = [
    "CameraObservation",
    "Crop",
    "DisFlow",
    "Flow",
    "Instance",
    "Networks",
    "Observation",
    "OnnxFlow",
    "OnnxNetworks",
    "OpenDepth",
    "Perception",
    "RangeEstimate",
    "SceneMaps",
    "group_instances",
    "load_networks",
]
