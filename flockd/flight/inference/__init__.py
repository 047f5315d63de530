"""ONNX networks with manifests: their inputs, outputs and runtimes. Independent of their use."""

from flockd.flight.inference.manifest import Manifest
from flockd.flight.inference.manifest_file import find_manifests, load_manifest, manifests_of
from flockd.flight.inference.session import OnnxModel

__all__ = ["Manifest", "OnnxModel", "find_manifests", "load_manifest", "manifests_of"]
