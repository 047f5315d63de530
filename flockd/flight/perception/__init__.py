"""Perception: frames in, an observation out; each role is an ONNX model with a manifest."""

from flockd.flight.perception.detection.instances import Instance, group_instances
from flockd.flight.perception.flow import DisFlow, OnnxFlow
from flockd.flight.perception.interface import ImageNetworks, ImagePair, ImageView, Networks, OneByOne, outcome
from flockd.flight.perception.maps import Crop, OpenDepth, RangeEstimate, SceneMaps
from flockd.flight.perception.observation import CameraObservation, Observation
from flockd.flight.perception.onnx import OnnxNetworks, load_networks
from flockd.flight.perception.pipeline import Perception

__all__ = [
    "CameraObservation",
    "Crop",
    "DisFlow",
    "ImageNetworks",
    "ImagePair",
    "ImageView",
    "Instance",
    "Networks",
    "Observation",
    "OneByOne",
    "OnnxFlow",
    "OnnxNetworks",
    "OpenDepth",
    "Perception",
    "RangeEstimate",
    "SceneMaps",
    "group_instances",
    "load_networks",
    "outcome",
]
