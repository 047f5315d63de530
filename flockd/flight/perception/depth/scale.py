"""What makes metres of an inverse depth that is known up to a factor, or up to a factor and a shift."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flockd.core.messages import Float32Array, FloatArray
from flockd.flight.geometry.robust.line import ransac_line
from flockd.flight.perception.maps import SceneMaps


@dataclass(frozen=True)
class ScaleParameters:
    """When pixels agree on a scale."""

    relative_tolerance: float = 0.1
    """Of the inverse depth: what is nearer to a scale than that agrees with it."""
    tolerance_sigmas: float = 2.0
    """The same in standard deviations of the target, where that is more."""
    min_share: float = 0.25
    """Of the pixels that have to agree: on a plain with trees and houses about half is ground."""
    min_pixels: int = 100
    max_depth_m: float = 1e3
    """Farther is as far: the sky's inverse depth is about 0, or less."""


DEFAULTS = ScaleParameters()


@dataclass(frozen=True)
class Scale:
    """``inverse depth = factor * open + shift``, in 1/m."""

    factor: float
    shift: float = 0.0

    def metric(self, maps: SceneMaps, parameters: ScaleParameters = DEFAULTS) -> SceneMaps:
        """The maps with metres; as they are where nothing is open."""
        if maps.open is None:
            return maps
        inverse = np.float32(self.factor) * maps.open.inverse + np.float32(self.shift)
        depth = 1.0 / np.maximum(inverse, np.float32(1.0 / parameters.max_depth_m))
        return replace(maps, depth=np.asarray(depth, np.float32), open=None)


def fit_scale(
    open_: FloatArray | Float32Array,
    target: FloatArray | Float32Array,
    sigma: FloatArray,
    *,
    shift: bool,
    parameters: ScaleParameters = DEFAULTS,
) -> Scale | None:
    """The scale that most pixels agree with, fitted to those; None where too few do.

    By RANSAC: what stands on the ground, moves by itself or was matched falsely does not count.

    Args:
        open_: (n,) what the network says.
        target: (n,) inverse depth, 1/m.
        sigma: (n,) standard deviation of the target, 1/m.
        shift: whether a shift is unknown as well.
        parameters: when pixels agree.
    """
    finite = np.isfinite(open_) & np.isfinite(target)
    x, y, spread = open_[finite].astype(np.float64), target[finite].astype(np.float64), sigma[finite]
    tolerance = np.maximum(parameters.relative_tolerance * np.abs(y), parameters.tolerance_sigmas * spread)
    found = ransac_line(
        x, y, tolerance, intercept=shift, min_inliers=parameters.min_pixels, min_inlier_ratio=parameters.min_share
    )
    return Scale(found.slope, found.intercept) if found else None
