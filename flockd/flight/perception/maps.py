"""Outputs of networks, in units: the maps of one image, and the range of the drone in one crop."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2

from flockd.core.messages import Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import ZMap
from flockd.flight.perception.detection.instances import Instance


@dataclass(frozen=True, eq=False)
class OpenDepth:
    """Depth known up to scale."""

    inverse: Float32Array
    """(h, w) inverse depth along the optical axis; a factor makes it 1/m."""
    shift: bool
    """Whether a shift is unknown too."""


@dataclass(frozen=True, eq=False)
class SceneMaps:
    """A network's maps of one image."""

    depth: ZMap | OpenDepth
    """(h, w) metres along the optical axis, the sky very far; or depth whose scale the ground's height gives."""
    labels: UInt8Array
    """(h, w) 0 for background, then one value for each drone."""
    instances: tuple[Instance, ...]

    @cached_property
    def labelled(self) -> tuple[slice, slice]:
        """The smallest part of the image, at least one pixel, that contains all labels: they are few."""
        left, top, width, height = cv2.boundingRect(self.labels)
        return slice(top, top + max(height, 1)), slice(left, left + max(width, 1))


class Crop(NamedTuple):
    """An image of one region of interest, taken by a virtual pinhole camera that faces it."""

    image: UInt8Array
    """(size, size, 3) RGB"""
    focal_px: float
    R_body_camera: FloatArray
    """(3, 3) from optical RDF to body FRD."""
    centre: FloatArray
    """(3,) optical centre, metres in the body."""
    mirrored: bool = False
    """Whether the network gets the mirror image, on which its errors differ. The estimate is for the crop itself."""
    evidence: float = 0.0
    """Log odds of a drone known before; they are added to the crop's."""


@dataclass(frozen=True)
class KnownSize:
    """Size of every drone of the fleet, from tip to tip, and its standard deviation."""

    size_m: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class RangeEstimate:
    """The second stage's estimate from one crop."""

    log_range: float
    """Natural logarithm of the range in metres, from the virtual camera's optical centre."""
    log_range_sigma: float
    """Standard deviation of `log_range`, given the size."""
    centre: FloatArray
    """(2,) u, v of the drone's centre in the crop."""
    size_m: float
    """The drone's size from tip to tip; its error is that of the range, but the same in every crop of one drone."""
    drone_probability: float = 1.0
    """Probability that there is a drone at all."""
    log_size_sigma: float = 0.0
    """Standard deviation of the logarithm of `size_m`. `log_range` has the same error besides its own."""
