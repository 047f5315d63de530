"""Optical flow: a network, OpenCV's DIS, or the one after the other."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from flockd.messages import Float32Array, UInt8Array
from flockd.perception.session import OnnxModel

_REFINED_TO_SCALE = 2
"""DIS after a network stops at a quarter of the size: 0.3 px instead of 0.15 px of error at the median, at a quarter of
the time, and an own motion just as good."""


class Flow(Protocol):
    """Where every pixel of the first image has gone in the second."""

    name: str

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2) pixels right and down."""
        ...


class OnnxFlow:
    """A flow network; enters images of the size that its manifest asks for."""

    def __init__(self, model: OnnxModel) -> None:
        self.name = model.manifest.name
        self._model = model
        self._scale = model.manifest.image_scale
        self._multiple = model.manifest.size_multiple

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """See ``Flow``."""
        height, width = first.shape[:2]
        size = (round(width * self._scale), round(height * self._scale))
        small = [_padded(_resized(image, size), self._multiple)[None] for image in (first, second)]
        (flow,) = self._model.run({"first": small[0], "second": small[1]}).values()
        inner = np.moveaxis(flow[0, :, : size[1], : size[0]], 0, 2)
        full = cv2.resize(inner, (width, height), interpolation=cv2.INTER_LINEAR)
        full *= np.array([width / size[0], height / size[1]], np.float32)
        return np.asarray(full, dtype=np.float32)


class DisFlow:
    """OpenCV's dense inverse search (Kroeger et al. 2016): alone for small computers, or after another flow.

    It is exact to a fraction of a pixel where it converges, but loses what moves far; a network is the other way round.
    """

    def __init__(self, start: Flow | None = None) -> None:
        """``start``: the flow to begin with at the coarsest scale; None: no motion."""
        self.name = f"{start.name}+dis" if start else "dis"
        self._start = start

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """See ``Flow``."""
        start = self._start.flow(first, second) if self._start else np.zeros((*first.shape[:2], 2), np.float32)
        grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (first, second)]
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # one a call: it is not for two threads
        if self._start:
            dis.setFinestScale(_REFINED_TO_SCALE)
        return np.asarray(dis.calc(grey[0], grey[1], start), dtype=np.float32)


def _resized(image: UInt8Array, size: tuple[int, int]) -> UInt8Array:
    if (image.shape[1], image.shape[0]) == size:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _padded(image: UInt8Array, multiple: int) -> UInt8Array:
    down, right = -image.shape[0] % multiple, -image.shape[1] % multiple
    if not down and not right:
        return image
    return np.asarray(cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)
