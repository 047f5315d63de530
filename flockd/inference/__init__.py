"""ONNX networks behind manifests: what enters, what comes out, what runs them. Knows nothing of drones."""

from flockd.inference.manifest import Manifest, find_manifests, load_manifest, manifests_of, models_folder
from flockd.inference.session import OnnxModel

__all__ = [
    "Manifest",
    "OnnxModel",
    "find_manifests",
    "load_manifest",
    "manifests_of",
    "models_folder",
]
