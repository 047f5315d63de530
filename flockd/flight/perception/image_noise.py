"""Whether an image is noise, as of interference: the networks find drones in it that are not there.

White noise is as strong at each scale, while scenes lose their contrast from scale to scale. The power spectrum of
photographs falls with the square of the frequency (Field 1987, Ruderman and Bialek 1994). So the diagonal details of an
orthonormal Haar transform are about half as strong at the finest scale as at the next. The strength of the finest
details alone (Donoho and Johnstone 1994, Immerkaer 1996) would not do: grass and leaves have as much of them as noise.

Noise that was filtered, as by a camera's own electronics, has the spectrum of gravel. It is told by how it comes: from
one image to the next, and everywhere, while what a drone sees changes little by little.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import BoolArray, Float32Array, UInt8Array

_BLOCK = 16
"""Details on one side of a block at the finest scale: two image pixels each."""
_SIGMA_PER_MEAN = float(np.sqrt(np.pi / 2))
"""Standard deviation over the mean magnitude, for normal numbers."""
_REMEMBERED_S = 30.0
"""Of a camera's images: what it showed before a hand, or a wall near by, covered it, is no noise when it comes back."""
_FORGOTTEN_S = 2.0
"""After so long without an image, a camera may see something else entirely."""


class NoiseShares(NamedTuple):
    """What of an image is noise, or may be: shares of its blocks of 32 x 32 pixels, 0 to 1."""

    white: float
    """Fine details are strong, and not much weaker than those of twice the size."""
    rough: float
    """Details of one of the three finest scales are very strong."""


def noise_shares(image: UInt8Array, parameters: NoiseParameters) -> NoiseShares:
    """Shares of noise in an RGB image (h, w, 3); 0 for one that is too small to say."""
    height, width = (length // (2 * _BLOCK) * 2 * _BLOCK for length in image.shape[:2])
    if not (height and width):
        return NoiseShares(0.0, 0.0)
    rest: Float32Array = cv2.cvtColor(image[:height, :width], cv2.COLOR_RGB2GRAY).astype(np.float32)
    sigmas = []
    for scale in range(3):
        details, rest = _haar(rest)
        sigmas.append(_sigmas(details, _BLOCK >> scale))
    fine, middle, coarse = sigmas
    white: BoolArray = (fine > parameters.level) & (fine > parameters.whiteness * middle)
    strong = parameters.rough_level
    rough: BoolArray = (fine > strong) | (middle > strong) | (coarse > 1.5 * strong)
    return NoiseShares(float(white.mean()), float(rough.mean()))


class NoiseMonitor:
    """Tells noisy images of a rig's cameras, by their noise and by what each camera showed before."""

    def __init__(self, parameters: NoiseParameters) -> None:
        self._parameters = parameters
        self._cameras: dict[str, _History] = {}

    def is_noisy(self, camera: str, image: UInt8Array, time_s: float) -> bool:
        """Whether the camera's newest image is not to be used; to be called once for each of its images.

        After a noisy image, so are those that follow until some in a row were clean.
        """
        history = self._cameras.setdefault(camera, _History())
        if abs(time_s - history.time_s) > _FORGOTTEN_S:
            history.used.clear()
        history.time_s = time_s
        while history.used and time_s - history.used[0][0] > _REMEMBERED_S:
            history.used.popleft()
        shares = noise_shares(image, self._parameters)
        if self._is_noise(shares, history):
            history.clean_needed = self._parameters.clean_images
            return True
        history.clean_needed = max(history.clean_needed - 1, 0)
        if history.clean_needed:
            return True
        history.used.append((time_s, shares))
        return False

    def forget(self, camera: str) -> None:
        """What the camera showed, as of a lens that is covered: once it is clear, any view may come all at once."""
        self._cameras.pop(camera, None)

    def _is_noise(self, shares: NoiseShares, history: _History) -> bool:
        parameters = self._parameters
        if shares.white > parameters.max_white:
            return True
        if not history.used:
            return False
        white_rise = shares.white - max(used.white for _, used in history.used)
        rough_rise = shares.rough - max(used.rough for _, used in history.used)
        return white_rise > parameters.max_white_rise or rough_rise > parameters.max_rough_rise


@dataclass
class _History:
    """History of one camera."""

    used: deque[tuple[float, NoiseShares]] = field(default_factory=deque)
    """Its last images that were, each with its time."""
    time_s: float = -np.inf
    """Time of its last image."""
    clean_needed: int = 0


def _haar(image: Float32Array) -> tuple[Float32Array, Float32Array]:
    """The diagonal details (h/2, w/2) of one level of the orthonormal Haar transform, and what is left for the next."""
    difference = cv2.subtract(image[0::2], image[1::2])
    rest = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.float32(0.5) * (difference[:, 0::2] - difference[:, 1::2]), np.asarray(2.0 * rest, np.float32)


def _sigmas(details: Float32Array, side: int) -> Float32Array:
    """The standard deviation of the details in each block of so many on a side, as if they were normal."""
    size = details.shape[1] // side, details.shape[0] // side
    sigmas: Float32Array = _SIGMA_PER_MEAN * cv2.resize(np.abs(details), size, interpolation=cv2.INTER_AREA)
    return sigmas
