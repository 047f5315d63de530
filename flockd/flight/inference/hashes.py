"""The SHA-256 of each model that a configuration uses, as recordings and replays compare them."""

from __future__ import annotations

from flockd.core.config.perception import PerceptionConfig
from flockd.flight.inference.manifest_file import load_manifest, manifests_of


def model_hashes(perception: PerceptionConfig) -> dict[str, str]:
    """SHA-256 of each model, by the name in its manifest. Raises ModelError."""
    manifests = [load_manifest(path)[0] for path in sorted(manifests_of(perception))]
    return {manifest.name: manifest.sha256 for manifest in manifests}
