"""From flow and depth maps to paired background points in the body frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray
from flockd.flight.geometry.depth_maps import RangeMap
from flockd.flight.geometry.rig import RigCamera


@dataclass(frozen=True, eq=False)
class Columns:
    """A value whose fields are arrays of equal length; to inherit from."""

    def __getitem__(self, which: Any) -> Self:
        """The rows of a mask or of indices."""
        return replace(self, **{name: column[which] for name, column in vars(self).items()})

    @classmethod
    def concatenate(cls, several: Sequence[Self]) -> Self:
        """The rows of one or more, in order."""
        names = vars(several[0])
        return replace(several[0], **{name: np.concatenate([vars(one)[name] for one in several]) for name in names})


@dataclass(frozen=True, eq=False)
class PointPairs(Columns):
    """n background points seen at an interval's start (in body frame C) and at its end (in body frame F)."""

    previous: FloatArray
    """(n, 3) metres in C."""
    current: FloatArray
    """(n, 3) metres in F."""
    camera_names: NDArray[np.str_]
    """(n,) the camera that saw each point, both times."""
    pixels_previous: FloatArray
    """(n, 2)"""
    pixels_current: FloatArray
    """(n, 2)"""

    def __len__(self) -> int:
        return len(self.previous)


def grid_pixels(size: tuple[int, int], stride: int) -> FloatArray:
    """(n, 2) pixel centres, ``stride`` apart both ways, of an image of ``size`` (width, height); row by row."""
    width, height = size
    u, v = np.arange(stride // 2, width, stride) + 0.5, np.arange(stride // 2, height, stride) + 0.5
    pixels = np.empty((len(v), len(u), 2))
    pixels[..., 0], pixels[..., 1] = u, v[:, None]
    return pixels.reshape(-1, 2)


def lift_matches(
    camera: RigCamera,
    pixels: FloatArray,
    flow: Float32Array,
    depth_previous: RangeMap,
    depth_current: RangeMap,
    labels_previous: NDArray[np.integer],
    labels_current: NDArray[np.integer],
    *,
    max_depth_m: float,
) -> PointPairs:
    """Matches ``p -> p + flow(p)`` of one camera as pairs of points in the body frame (Eq. 6, then the extrinsics).

    ``pixels`` (n, 2) of the previous image; all maps have the camera's size: ``flow`` (h, w, 2) pixels, depths (h, w)
    metres along the ray, labels (h, w) integers, 0 of the background. A pair is dropped if an end lies outside the
    image or the background, or its depth is not finite, not positive or above ``max_depth_m``. Raises ValueError for a
    map of another size.
    """
    width, height = camera.camera.size
    maps = (flow[..., 0], depth_previous, depth_current, labels_previous, labels_current)
    for what, shape in zip(("flow", "depth", "depth", "labels", "labels"), (m.shape for m in maps), strict=True):
        if shape != (height, width):
            raise ValueError(f"camera {camera.name!r} is {width}x{height}, but its {what} map is {shape[1]}x{shape[0]}")
    pixels_previous = pixels.take(camera.camera.in_image(pixels).nonzero()[0], axis=0)
    pixels_current = pixels_previous + _nearest(flow, pixels_previous)
    inside = camera.camera.in_image(pixels_current).nonzero()[0]
    pixels_previous, pixels_current = pixels_previous.take(inside, axis=0), pixels_current.take(inside, axis=0)
    range_previous = _nearest(depth_previous, pixels_previous).astype(np.float64)
    range_current = _nearest(depth_current, pixels_current).astype(np.float64)
    # NaN compares false, so depths that are not finite are dropped too.
    kept = (range_previous > 0.0) & (range_previous <= max_depth_m)
    kept &= (range_current > 0.0) & (range_current <= max_depth_m)
    kept &= (_nearest(labels_previous, pixels_previous) == 0) & (_nearest(labels_current, pixels_current) == 0)
    previous = camera.camera.unproject(pixels_previous, range_previous)
    current = camera.camera.unproject(pixels_current, range_current)
    # Outside a fisheye's image circle there is no ray.
    places = (kept & np.isfinite(previous[:, 0]) & np.isfinite(current[:, 0])).nonzero()[0]
    return PointPairs(
        previous=camera.T_body_camera.apply(previous.take(places, axis=0)),
        current=camera.T_body_camera.apply(current.take(places, axis=0)),
        camera_names=np.full(len(places), camera.name),
        pixels_previous=pixels_previous.take(places, axis=0),
        pixels_current=pixels_current.take(places, axis=0),
    )


_Value = TypeVar("_Value", bound=np.generic)


def _nearest(values: NDArray[_Value], pixels: FloatArray) -> NDArray[_Value]:
    """The value of the pixel that contains each of ``pixels`` (n, 2), which are inside the image."""
    column, row = pixels.astype(np.int64).T
    found: NDArray[_Value] = values[row, column]
    return found
