"""ONNX networks with manifests: their inputs, outputs and runtimes. Independent of their use."""

from flockd.flight.inference.manifest import Fault, Manifest
from flockd.flight.inference.manifest_file import (
    find_manifests,
    load_manifest,
    manifest_path,
    manifests_of,
    models_folder,
    read_manifest,
)
from flockd.flight.inference.session import OnnxModel

__all__ = [
    "Fault",
    "Manifest",
    "OnnxModel",
    "find_manifests",
    "load_manifest",
    "manifest_path",
    "manifests_of",
    "models_folder",
    "read_manifest",
]
