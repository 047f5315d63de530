"""What perception asks of networks: flow of a pair of images, depth and drones of one, range of the drone in a crop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from flockd.core.messages import Float32Array, Frame, UInt8Array
from flockd.flight.geometry import RigCamera
from flockd.flight.perception.detection.second_stage import SecondStage
from flockd.flight.perception.maps import Crop, RangeEstimate, SceneMaps


class Networks(Protocol):
    """What perception asks of networks: `OnnxNetworks`, or exact ones that a simulator puts in their place."""

    @property
    def map_stride(self) -> int:
        """Image pixels per pixel of the first stage's maps."""
        ...

    @property
    def second_stage(self) -> SecondStage | None:
        """How the crops are cut that `ranges` takes; None: there is no second stage."""
        ...

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """(h, w, 2) pixels from the first image to the second.

        ``labels`` (h, w) of the first image: one value a drone, 0 and 255 none.
        """
        ...

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """Depth and drones of one image.

        ``ground`` (h / map_stride, w / map_stride) is the inverse depth (1/m) of flat ground, where attitude and height
        are to fix the scale.
        """
        ...

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each crop.

        The range may be NaN where the probability is no more than `second_stage` asks for another crop.
        """
        ...


class Flow(Protocol):
    """A method of optical flow: where every pixel of the first image has gone in the second."""

    name: str

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2) pixels right and down."""
        ...
