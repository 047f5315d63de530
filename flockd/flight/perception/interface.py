"""What perception asks of networks: flow of a pair of images, depth and drones of one, range of the drone in a crop."""

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
"""What one camera's image may end in: an output that is not finite, a height below the ground, an image to no use."""


class ImageView(NamedTuple):
    """One image, for its depth and drones."""

    frame: Frame
    camera: RigCamera
    ground: Float32Array | None
    """(h / map_stride, w / map_stride) the inverse depth (1/m) of flat ground, where attitude and height are to fix the
    scale."""


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
        """How the crops are cut that `ranges` takes; None: there is no second stage."""
        ...

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each crop.

        The range may be NaN where the probability is no more than `second_stage` asks for another crop.
        """
        ...


class Networks(_Stages, Protocol):
    """What perception asks of networks: `OnnxNetworks`, or exact ones that a simulator puts in their place."""

    def flows(self, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """Of each pair (h, w, 2) pixels from the first image to the second, or one of `CAMERA_FAULTS`."""
        ...

    def scenes(self, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """Depth and drones of each image, or one of `CAMERA_FAULTS`."""
        ...


class ImageNetworks(_Stages, Protocol):
    """The same for one image, or one pair, at a time: what `OneByOne` makes `Networks` of."""

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """Of one `ImagePair`; raises one of `CAMERA_FAULTS`."""
        ...

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """Of one `ImageView`; raises one of `CAMERA_FAULTS`."""
        ...


class OneByOne:
    """Answers for several images one after the other; to inherit from."""

    def flows(self: ImageNetworks, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """See `Networks`."""
        return [outcome(self.flow, *pair) for pair in pairs]

    def scenes(self: ImageNetworks, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """See `Networks`."""
        return [outcome(self.scene, *view) for view in views]


def outcome(function: Callable[..., T], *arguments: object) -> T | Exception:
    """What a function returns, or which of `CAMERA_FAULTS` it raises."""
    try:
        return function(*arguments)
    except CAMERA_FAULTS as error:
        return error


class Flow(Protocol):
    """A method of optical flow: where every pixel of the first image has gone in the second."""

    name: str

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2) pixels right and down."""
        ...
