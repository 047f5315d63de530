"""Colour models of a drone and its surroundings: networks are too coarse for its outline, thin arms and propellers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray, UInt8Array

_LEVELS = 20
"""Histogram bins of red, green and blue each: 8,000 bins, which the thousands of pixels around a drone can fill."""
_SHADES = 0.5 * np.eye(_LEVELS) + 0.25 * (np.eye(_LEVELS, k=1) + np.eye(_LEVELS, k=-1))
"""A colour also counts, by less, for those beside it: the binomial kernel 1 2 1 over 4."""
_MIN_LOGIT = -8.0
"""From here on a pixel may be the drone's at all, or lies so near to it that it shows what surrounds it."""
_RARE = 0.02
"""Prior count of pixels of every colour, in the drone and around it."""


def reweight_by_colour(logit: Float32Array, image: UInt8Array, weight: float) -> Float32Array:
    """Logits of pixels being a drone's, by how much oftener their colours are the drone's than its surroundings'.

    Both are histograms of the same pixels, each counted by the probability that it has so far (as by the colour models
    of Rother, Kolmogorov & Blake 2004, "GrabCut"). A drone that has the colours of what is around it stays as it is.

    Args:
        logit: (h, w) as the networks say.
        image: (h, w, 3) RGB.
        weight: of the colours. Their evidence is each pixel's own, that of the networks much the same for its
            neighbours.
    """
    possible = logit > _MIN_LOGIT
    share = 1.0 / (1.0 + np.exp(-logit[possible].astype(np.float64)))
    colour = (image[possible].astype(np.int64) * _LEVELS >> 8) @ (_LEVELS**2, _LEVELS, 1)
    own, other = (_frequency(colour, part) for part in (share, 1.0 - share))
    reweighted = logit.copy()
    reweighted[possible] += weight * np.log(own / other)
    return reweighted


def _frequency(colour: NDArray[np.int64], weight: FloatArray) -> FloatArray:
    """How frequent each pixel's colour is among all, up to a factor that is the same whatever the weights."""
    counts = np.bincount(colour, weight, _LEVELS**3).astype(np.float64)
    for _ in range(3):
        counts = (_SHADES @ counts.reshape(_LEVELS, -1)).T.ravel()  # each colour's turn, and back in order after three
    return np.asarray((counts[colour] + _RARE) / (weight.sum() + _RARE))
