"""Inputs for a model without real images: the golden input, and inputs of a camera's size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import UInt8Array
from flockd.flight.inference.fitting import Size, entering, fit
from flockd.flight.inference.manifest import Manifest

Feeds = dict[str, NDArray[Any]]
"""Arrays by the names of a model's inputs."""


def golden_image(size: Size, seed: int = 0) -> UInt8Array:
    """A fixed smooth random image, (height, width, 3) RGB."""
    noise = np.random.Generator(np.random.PCG64(seed)).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def golden_feeds(manifest: Manifest) -> Feeds:
    """The golden input: a fixed image for every image, zeros for planes."""
    return _feeds(manifest, manifest.golden_size, 1)


def feeds_for(manifest: Manifest, image: Size, batch: int = 1) -> Feeds:
    """Inputs for an image of this size, width and height, or for a batch of crops; their content does not matter."""
    if manifest.crop is None:
        return _feeds(manifest, fit(manifest, image).full, 1)
    return _feeds(manifest, (manifest.crop_size_px, manifest.crop_size_px), batch)


def shapes_of(feeds: Mapping[str, NDArray[Any]]) -> dict[str, list[int]]:
    """The inputs' shapes."""
    return {name: list(value.shape) for name, value in feeds.items()}


def _feeds(manifest: Manifest, size: Size, batch: int) -> Feeds:
    """Feeds for ``batch`` input images of ``size``, of other content for each input. Planes are zero."""
    feeds: Feeds = {}
    for number, (name, spec) in enumerate(manifest.inputs.items()):
        if spec.kind == "image":
            feeds[name] = entering(spec, [golden_image(size, number + seed) for seed in range(batch)])
            continue
        planes, stride = spec.shape[1], manifest.map_stride
        assert isinstance(planes, int)
        assert stride is not None  # `Manifest.faults` requires both for planes
        feeds[name] = np.zeros((1, planes, size[1] // stride, size[0] // stride), spec.dtype)
    return feeds
