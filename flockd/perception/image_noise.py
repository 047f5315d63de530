"""Whether an image is noise: interference, a failing sensor. A noisy camera shows the networks drones that are not there.

White noise is as strong at each scale, while scenes lose their contrast from scale to scale: the power spectrum of
photographs falls with the square of the frequency (Field 1987, Ruderman and Bialek 1994), so that the diagonal details
of an orthonormal Haar transform are about half as strong at the finest scale as at the next. The strength of the finest
details alone (Donoho and Johnstone 1994, Immerkaer 1996) would not do: grass and leaves have as much of them as noise.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median

import cv2
import numpy as np

from flockd.config.perception import NoiseParameters
from flockd.messages import Float32Array, UInt8Array

_BLOCK = 16
"""Details on one side of a block at the finest scale: two image pixels each."""
_SIGMA_PER_MEAN = float(np.sqrt(np.pi / 2))
"""Of normal numbers: the standard deviation over the mean magnitude."""
_REMEMBERED = 20
"""Images of a camera whose shares are its history."""


def noise_share(image: UInt8Array, parameters: NoiseParameters) -> float:
    """The share, 0 to 1, of an RGB image (h, w, 3) that is noise; 0 for one that is too small to say.

    Noise are blocks of 32 x 32 pixels whose finest details are stronger than ``parameters.level``, and not much weaker
    than those of twice the size.
    """
    height, width = (length // (2 * _BLOCK) * 2 * _BLOCK for length in image.shape[:2])
    if not (height and width):
        return 0.0
    grey = cv2.cvtColor(image[:height, :width], cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, rest = _haar(grey)
    coarse, _ = _haar(rest)
    fine_sigma, coarse_sigma = _sigmas(fine, _BLOCK), _sigmas(coarse, _BLOCK // 2)
    noisy = (fine_sigma > parameters.level) & (fine_sigma > parameters.whiteness * coarse_sigma)
    return float(noisy.mean())


class NoiseMonitor:
    """Tells noisy images of a rig's cameras, by their noise and by what each camera showed before."""

    def __init__(self, parameters: NoiseParameters) -> None:
        self._parameters = parameters
        self._cameras: dict[str, _History] = {}

    def is_noisy(self, camera: str, image: UInt8Array) -> bool:
        """Whether the camera's newest image is not to be used; to be called once for each of its images.

        After a noisy image, so are those that follow until some in a row were clean.
        """
        parameters, history = self._parameters, self._cameras.setdefault(camera, _History())
        share = noise_share(image, parameters)
        usual = median(history.shares) if history.shares else parameters.max_share
        if share > min(parameters.max_share, usual + parameters.max_rise):
            history.clean_needed = parameters.clean_images
            return True
        history.clean_needed = max(history.clean_needed - 1, 0)
        if history.clean_needed:
            return True
        history.shares.append(share)
        return False


@dataclass
class _History:
    """Of one camera."""

    shares: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    """Of its last images that were used."""
    clean_needed: int = 0


def _haar(image: Float32Array) -> tuple[Float32Array, Float32Array]:
    """The diagonal details (h/2, w/2) of one level of the orthonormal Haar transform, and what is left for the next."""
    upper, lower = image[0::2], image[1::2]
    difference, total = upper - lower, upper + lower
    details: Float32Array = (difference[:, 0::2] - difference[:, 1::2]) / 2
    rest: Float32Array = (total[:, 0::2] + total[:, 1::2]) / 2
    return details, rest


def _sigmas(details: Float32Array, side: int) -> Float32Array:
    """The standard deviation of the details in each block of so many on a side, as if they were normal."""
    height, width = details.shape
    sigmas: Float32Array = _SIGMA_PER_MEAN * np.abs(details).reshape(height // side, side, width // side, side).mean(
        axis=(1, 3)
    )
    return sigmas
