"""Inputs for a model without real images: the golden input, and empty inputs of a camera's size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import UInt8Array
from flockd.flight.inference.fitting import Size, entering, fit
from flockd.flight.inference.manifest import InputSpec, Manifest

Feeds = dict[str, NDArray[Any]]
"""By input."""


def golden_image(size: Size, seed: int = 0) -> UInt8Array:
    """A fixed smooth random image, (height, width, 3) RGB."""
    noise = np.random.Generator(np.random.PCG64(seed)).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def golden_feeds(manifest: Manifest) -> Feeds:
    """The golden input: a fixed image for every image, zeros for planes."""
    size, feeds = manifest.golden_size, {}
    for index, (name, spec) in enumerate(manifest.inputs.items()):
        if spec.kind == "planes":
            feeds[name] = _zeros(manifest, spec, size)
        else:
            feeds[name] = entering(spec, [golden_image(size, index)])
    return feeds


def feeds_for(manifest: Manifest, image: Size, batch: int = 1) -> Feeds:
    """Empty inputs for images of a camera, or for a batch of crops."""
    fitting, feeds = fit(manifest, image), {}
    for name, spec in manifest.inputs.items():
        if spec.kind == "planes":
            feeds[name] = _zeros(manifest, spec, fitting.full)
        elif manifest.crop is not None:
            size = (manifest.crop_size_px, manifest.crop_size_px)
            feeds[name] = entering(spec, [golden_image(size, seed) for seed in range(batch)])
        else:
            feeds[name] = entering(spec, [fitting.enter(golden_image(image))])
    return feeds


def shapes_of(feeds: Mapping[str, NDArray[Any]]) -> dict[str, list[int]]:
    """The inputs' shapes."""
    return {name: list(value.shape) for name, value in feeds.items()}


def _zeros(manifest: Manifest, spec: InputSpec, size: Size) -> NDArray[Any]:
    """Planes of an input image of this size."""
    planes, stride = spec.shape[1], manifest.map_stride
    assert isinstance(planes, int)
    assert stride is not None  # a manifest with planes has both
    return np.zeros((1, planes, size[1] // stride, size[0] // stride), spec.dtype)
