"""One translation for a whole image: where a camera turned so far that no flow converges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.perception.flow.images import shrunk

_SHORTER_SIDE_PX = 45
"""Shorter side of the small images that are compared: at this size a motion of half the image is some 20 pixels, and
the blur of a fast turn one or two."""
_MIN_OVERLAP = 0.3
"""Share of an image: less than this in common correlates by chance."""


def translation_flow(first: UInt8Array, second: UInt8Array) -> Float32Array:
    """(h, w, 2) pixels from the grey image ``first`` (h, w) to ``second``: the same everywhere."""
    return np.full((*first.shape, 2), global_translation(first, second), np.float32)


def global_translation(first: UInt8Array, second: UInt8Array) -> tuple[float, float]:
    """How far the grey image ``first`` (h, w) has gone in ``second``, pixels right and down, if all of it moves alike.

    The translation with the highest normalised cross-correlation of what overlaps (Padfield, Masked object registration
    in the Fourier domain, 2012), to one pixel of the small images.
    """
    a, b = _small(first), _small(second)
    height, width = a.shape
    size = (2 * height, 2 * width)
    correlation = _correlations(a, b, size)
    down, right = np.unravel_index(int(np.argmax(correlation)), size)
    scale_x, scale_y = first.shape[1] / width, first.shape[0] / height
    # The second half of the spectrum's range is translations up and left.
    return scale_x * ((right + width) % size[1] - width), scale_y * ((down + height) % size[0] - height)


def flow_correlation(first: UInt8Array, second: UInt8Array, flow: Float32Array) -> float:
    """How a grey ``first`` (h, w), made small, correlates with ``second`` where ``flow`` (h, w, 2) leads: -1 to 1.

    0 where most of it leads out of the image.
    """
    a, b = _small(first), _small(second)
    height, width = a.shape
    small = cv2.resize(flow, (width, height), interpolation=cv2.INTER_NEAREST)  # enough, and a third of the time
    x = np.arange(width, dtype=np.float32) + small[..., 0] * np.float32(width / first.shape[1])
    y = np.arange(height, dtype=np.float32)[:, None] + small[..., 1] * np.float32(height / first.shape[0])
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    if inside.mean() < _MIN_OVERLAP:
        return 0.0
    warped = cv2.remap(b, x, y, cv2.INTER_LINEAR)[inside]
    seen = a[inside]
    spread = float(seen.std() * warped.std())
    return float(((seen - seen.mean()) * (warped - warped.mean())).mean()) / spread if spread > 0 else 0.0


def _correlations(a: NDArray[np.float32], b: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.floating]:
    """Normalised cross-correlation of (h, w) images for every translation, FFTs of ``size``; -1 for small overlaps."""
    ones = np.fft.rfft2(np.ones_like(a), size)
    spectrum_a, spectrum_b = np.fft.rfft2(a, size), np.fft.rfft2(b, size)

    def summed(before: NDArray[np.complexfloating], after: NDArray[np.complexfloating]) -> NDArray[np.floating]:
        """The sum over the overlap of one image's pixel times the other's, for every translation."""
        product: NDArray[np.floating] = np.fft.irfft2(np.conj(before) * after, size)
        return product

    count = np.maximum(summed(ones, ones), 1.0)
    sum_a, sum_b = summed(spectrum_a, ones), summed(ones, spectrum_b)
    spread_a = summed(np.fft.rfft2(a * a, size), ones) - sum_a**2 / count
    spread_b = summed(ones, np.fft.rfft2(b * b, size)) - sum_b**2 / count
    correlation: NDArray[np.floating] = (summed(spectrum_a, spectrum_b) - sum_a * sum_b / count) / np.sqrt(
        np.maximum(spread_a, 1.0) * np.maximum(spread_b, 1.0)
    )
    correlation[count < _MIN_OVERLAP * a.size] = -1.0
    return correlation


def _small(image: UInt8Array) -> NDArray[np.float32]:
    factor = min(1.0, _SHORTER_SIDE_PX / min(image.shape))
    size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
    return shrunk(image, size).astype(np.float32)
