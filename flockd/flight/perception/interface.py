"""Interface of the networks: flow of an image pair, depth and drones of one image, range of the drone in a crop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar

import cv2

from flockd.core.messages import Float32Array, Frame, UInt8Array
from flockd.flight.geometry import RigCamera
from flockd.flight.perception.detection.second_stage import SecondStage
from flockd.flight.perception.maps import Crop, RangeEstimate, SceneMaps

T = TypeVar("T")
CAMERA_FAULTS = (FloatingPointError, ValueError, cv2.error)
"""Errors that one camera's image may cause: output not finite, height below the ground, unusable image."""


class ImageView(NamedTuple):
    """One image, for its depth and drones."""

    frame: Frame
    camera: RigCamera
    ground: Float32Array | None
    """(h / map_stride, w / map_stride) inverse depth of flat ground, 1/m; None: not used for the scale."""


class ImagePair(NamedTuple):
    """Two images of a camera, for the flow from the first to the second."""

    first: Frame
    second: Frame
    labels: UInt8Array
    """(h, w) of the first image: one value a drone, 0 and 255 none."""


class _Stages(Protocol):
    @property
    def map_stride(self) -> int:
        """Image pixels per pixel of the first stage's maps."""
        ...

    @property
    def second_stage(self) -> SecondStage | None:
        """How the crops for `ranges` are cut; None: there is no second stage."""
        ...

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each crop.

        The range may be NaN if the probability is at most `Thresholds.another_crop`.
        """
        ...


class Networks(_Stages, Protocol):
    """Interface of all networks: `OnnxNetworks`, or exact ones that a simulator puts in their place."""

    def flows(self, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """For each pair (h, w, 2) pixels from the first image to the second, or one of `CAMERA_FAULTS`."""
        ...

    def scenes(self, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """Depth and drones of each image, or one of `CAMERA_FAULTS`."""
        ...


class ImageNetworks(_Stages, Protocol):
    """The same for one image or pair at a time; `OneByOne` makes `Networks` of it."""

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """Flow of one `ImagePair`; raises one of `CAMERA_FAULTS`."""
        ...

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """Maps of one `ImageView`; raises one of `CAMERA_FAULTS`."""
        ...


class OneByOne:
    """Processes several images one after the other; to inherit from."""

    def flows(self: ImageNetworks, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """See `Networks`."""
        return [outcome(self.flow, *pair) for pair in pairs]

    def scenes(self: ImageNetworks, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """See `Networks`."""
        return [outcome(self.scene, *view) for view in views]


def outcome(function: Callable[..., T], *arguments: object) -> T | Exception:
    """The return value of a function, or the one of `CAMERA_FAULTS` that it raises."""
    try:
        return function(*arguments)
    except CAMERA_FAULTS as error:
        return error


class Flow(Protocol):
    """A method of optical flow: the displacement of each pixel of the first image in the second."""

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2) pixels right and down."""
        ...
