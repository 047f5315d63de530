"""What networks say, in units: the maps of one image, and the range of the drone in one crop."""

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
    """Depth that a network knows up to its scale."""

    inverse: Float32Array
    """(h, w): a factor makes 1/m along the optical axis of it."""
    shift: bool
    """Whether something has to be added as well: the inverse depth is known up to scale and shift."""


@dataclass(frozen=True, eq=False)
class SceneMaps:
    """What the networks say of one image."""

    depth: ZMap | OpenDepth
    """(h, w) metres along the optical axis, the sky very far; or what ground of known height gives its scale."""
    labels: UInt8Array
    """(h, w) 0 for background, then one value a drone."""
    instances: tuple[Instance, ...]

    @cached_property
    def labelled(self) -> tuple[slice, slice]:
        """The part of the image, at least one pixel, that has all labels: they are few."""
        left, top, width, height = cv2.boundingRect(self.labels)
        return slice(top, top + max(height, 1)), slice(left, left + max(width, 1))


class Crop(NamedTuple):
    """A small image of one region of interest, as a virtual camera that faces it sees it: a pinhole."""

    image: UInt8Array
    """(size, size, 3) RGB"""
    focal_px: float
    R_body_camera: FloatArray
    """(3, 3) from optical RDF to body FRD."""
    centre: FloatArray
    """(3,) the camera's, metres in the body."""
    mirrored: bool = False
    """Whether the network is to be given the mirror image, on which it errs differently. The estimate is as if not."""
    evidence: float = 0.0
    """Log odds of a drone that are known already; they add to what the crop shows."""


@dataclass(frozen=True)
class KnownSize:
    """Size of every drone of the fleet, from tip to tip, and its standard deviation."""

    size_m: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class RangeEstimate:
    """What the second stage says of one crop."""

    log_range: float
    """Natural logarithm of the range in metres, from the virtual camera's optical centre."""
    log_range_sigma: float
    """Standard deviation of `log_range`, if the size is right."""
    centre: FloatArray
    """(2,) u, v of the drone's centre in the crop."""
    size_m: float
    """The drone's size from tip to tip; errs like the range does, but is the same in every crop of one drone."""
    drone_probability: float = 1.0
    """Probability that there is a drone at all."""
    log_size_sigma: float = 0.0
    """Standard deviation of the logarithm of `size_m`. `log_range` errs with it, by as much again."""
