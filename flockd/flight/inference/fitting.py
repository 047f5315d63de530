"""Pre- and post-processing: from an image to a model's input, and from the model's maps back to the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.inference.manifest import InputSpec, Manifest, OutputSpec

Size = tuple[int, int]
"""Width and height, pixels."""


@dataclass(frozen=True)
class Fitting:
    """An image resized to ``inner`` at the top left of the ``full`` input; its border pixels fill the rest."""

    image: Size
    inner: Size
    full: Size

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of the input per pixel of the image, right and down."""
        return self.inner[0] / self.image[0], self.inner[1] / self.image[1]

    def enter(self, image: UInt8Array) -> UInt8Array:
        """Resizes and pads an image (h, w, 3) to the size of the input."""
        if self.inner != self.image:
            shrinks = self.inner[0] <= self.image[0]
            how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, self.inner, interpolation=how), dtype=np.uint8)
        right, down = self.full[0] - self.inner[0], self.full[1] - self.inner[1]
        if not down and not right:
            return image
        return np.asarray(cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)

    def enter_planes(self, planes: Float32Array, stride: int) -> Float32Array:
        """Resizes and pads planes (c, h / stride, w / stride) of an image to the size of the input."""
        width, height = self.inner[0] // stride, self.inner[1] // stride
        if planes.shape[1:] != (height, width):
            resized = [cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR) for plane in planes]
            planes = np.array(resized, np.float32)
        down, right = self.full[1] // stride - height, self.full[0] // stride - width
        if not down and not right:
            return planes
        return np.array([cv2.copyMakeBorder(plane, 0, down, 0, right, cv2.BORDER_REPLICATE) for plane in planes])

    def inside(self, map_: Float32Array) -> Float32Array:
        """Crops a map (..., h, w) of the whole input, at any resolution, to the image."""
        height, width = map_.shape[-2:]
        return map_[..., : round(height * self.inner[1] / self.full[1]), : round(width * self.inner[0] / self.full[0])]


def fit(manifest: Manifest, image: Size) -> Fitting:
    """The resizing and padding of images of this size, width and height, for a model."""
    fixed = manifest.fixed_size
    if fixed is not None:
        scale = min(fixed[0] / image[0], fixed[1] / image[1])
        return Fitting(image, (round(image[0] * scale), round(image[1] * scale)), fixed)
    scale = max(manifest.image_scale, min(manifest.least_side_px / min(image), 1.0))
    inner = (round(image[0] * scale), round(image[1] * scale))
    multiple = manifest.size_multiple
    return Fitting(image, inner, (inner[0] + -inner[0] % multiple, inner[1] + -inner[1] % multiple))


def entering(spec: InputSpec, images: Sequence[UInt8Array] | NDArray[Any]) -> NDArray[Any]:
    """Converts n RGB images (h, w, 3) of the input's size to its batch, in its colour, layout and scale."""
    if spec.colour == "bgr":
        images = [image[..., ::-1] for image in images]
    elif spec.colour == "grey":
        images = [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)[..., None] for image in images]
    batch: NDArray[Any] = np.asarray(images)
    if spec.dtype != "uint8":
        batch = batch.astype(np.float32) * np.float32(spec.white / 255.0)
        if spec.mean:
            batch -= np.array(spec.mean, np.float32)
        if spec.deviation:
            batch /= np.array(spec.deviation, np.float32)
    if spec.layout == "nchw":
        batch = np.moveaxis(batch, 3, 1)
    return np.ascontiguousarray(batch, dtype=spec.dtype)


def leaving(spec: OutputSpec, output: NDArray[Any]) -> Float32Array:
    """Converts an output to float32 in its unit; maps to (n, c, h, w)."""
    values = np.asarray(output, dtype=np.float32)
    if values.ndim == 3:
        values = values[:, None]
    elif values.ndim == 4 and spec.layout == "nhwc":
        values = np.moveaxis(values, 3, 1)
    return values if spec.factor == 1.0 else values * np.float32(spec.factor)
