"""Perception: images in, flow, depth and separate drones out; each role an ONNX model behind a manifest."""

from flockd.perception.flow import DisFlow, Flow, OnnxFlow
from flockd.perception.instances import Instance, group_instances
from flockd.perception.manifest import Manifest, find_manifests, load_manifest, manifests_of, models_folder
from flockd.perception.roles import OpenDepth, Perception, Picture, RangeEstimate, SceneMaps
from flockd.perception.session import OnnxModel

__all__ = [
    "DisFlow",
    "Flow",
    "Instance",
    "Manifest",
    "OnnxFlow",
    "OnnxModel",
    "OpenDepth",
    "Perception",
    "Picture",
    "RangeEstimate",
    "SceneMaps",
    "find_manifests",
    "group_instances",
    "load_manifest",
    "manifests_of",
    "models_folder",
]
