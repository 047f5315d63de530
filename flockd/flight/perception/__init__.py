"""Perception: frames in, an observation out; each role is an ONNX model with a manifest."""

from flockd.flight.perception.interface import (
    Crops,
    ImagePair,
    ImageView,
    Networks,
    OneByOne,
    RangeEstimates,
    SceneMaps,
    outcome,
)
from flockd.flight.perception.observation import Observation
from flockd.flight.perception.onnx import OnnxNetworks, load_networks
from flockd.flight.perception.pipeline import Perception

__all__ = [
    "Crops",
    "ImagePair",
    "ImageView",
    "Networks",
    "Observation",
    "OneByOne",
    "OnnxNetworks",
    "Perception",
    "RangeEstimates",
    "SceneMaps",
    "load_networks",
    "outcome",
]
