"""Interface of the networks: flow of an image pair, depth and drones of one image, range of the drone in a crop."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

import cv2
import numpy as np

from flockd.core.errors import ModelError
from flockd.core.messages import BoolArray, Float32Array, FloatArray, Frame, UInt8Array
from flockd.flight.geometry import RigCamera, ZMap
from flockd.flight.geometry.pairs import Columns
from flockd.flight.inference import Manifest
from flockd.flight.inference.manifest import CropSpec
from flockd.flight.perception.detection.instances import Instance

T = TypeVar("T")
CAMERA_FAULTS = (FloatingPointError, ValueError, cv2.error)
"""Errors that one camera's image may cause: output not finite, height below the ground, unusable image."""


@dataclass(frozen=True, eq=False)
class SceneMaps:
    """A network's maps of one image."""

    depth: ZMap
    """(h, w) metres along the optical axis, the sky very far."""
    labels: UInt8Array
    """(h, w) 0 for background, then one value for each drone."""
    instances: tuple[Instance, ...]


@dataclass(frozen=True, eq=False)
class Crops(Columns):
    """Images of n regions of interest, taken by virtual pinhole cameras that each face one."""

    images: UInt8Array
    """(n, size, size, 3) RGB"""
    focal_px: FloatArray
    """(n,)"""
    R_body_camera: FloatArray
    """(n, 3, 3) from optical RDF to body FRD."""
    centres: FloatArray
    """(n, 3) optical centres, metres in the body."""
    mirrored: BoolArray
    """(n,) whether the network gets the mirror image, on which its errors differ. The estimate is for the crop itself.
    """
    evidence: FloatArray
    """(n,) log odds of a drone known before; they are added to the crop's."""

    def __len__(self) -> int:
        return len(self.images)


class RangeEstimates(NamedTuple):
    """The second stage's estimates from n crops; NaN: there is none."""

    log_range: FloatArray
    """(n,) natural logarithm of the range in metres, from the virtual camera's optical centre."""
    log_range_sigma: FloatArray
    """(n,) standard deviation of `log_range`, given the size."""
    centre: FloatArray
    """(n, 2) u, v of the drone's centre in the crop."""
    size_m: FloatArray
    """(n,) the drone's size from tip to tip; its error is that of the range, but the same in every crop of a drone."""
    drone_probability: FloatArray
    """(n,) probability that there is a drone at all."""
    log_size_sigma: FloatArray
    """(n,) standard deviation of the logarithm of `size_m`. `log_range` has the same error besides its own."""

    @classmethod
    def unknown(cls, count: int) -> RangeEstimates:
        """Of so many crops, without any estimate."""
        log_range, sigma, *rest = np.full((5, count), np.nan)
        return cls(log_range, sigma, np.full((count, 2), np.nan), *rest)


@dataclass(frozen=True)
class SecondStage:
    """How the second stage's crops are cut and its outputs judged, as its manifests say."""

    crop_size: int
    """Width and height of its crops, pixels."""
    rules: CropSpec
    drone_probability: float
    """From this probability on, one picture alone shows a drone."""
    another_crop_probability: float
    """A proposal with at most this probability is rejected without another crop."""
    mean_sigma_factor: float
    """Error of the mean of a crop and its mirrored one, relative to that of a single crop."""
    min_relative_sigma: float
    bearing_sigma_rad: float

    @classmethod
    def of(cls, distance: Manifest, verification: Manifest | None = None) -> SecondStage:
        """The second stage from a distance network, and the verification network whose probability replaces its own.

        Raises ModelError if the two take crops of different sizes.
        """
        judge, of_range = verification or distance, distance.thresholds
        if judge.fixed_size != distance.fixed_size:
            raise ModelError(
                f"perception.verification: model {judge.name} takes crops of another size than {distance.name}; "
                "choose one that takes the same"
            )
        assert distance.crop is not None  # as the role requires
        return cls(
            crop_size=distance.crop_size_px,
            rules=distance.crop,
            drone_probability=judge.thresholds["drone_probability"],
            another_crop_probability=judge.thresholds["another_crop_probability"],
            mean_sigma_factor=of_range["mean_sigma_factor"],
            min_relative_sigma=of_range["min_relative_sigma"],
            bearing_sigma_rad=of_range["bearing_sigma_rad"],
        )


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


class Networks(Protocol):
    """All networks of a drone: `OnnxNetworks`, those that watch them, or a simulator's exact ones."""

    map_stride: int
    """Image pixels per pixel of the first stage's maps."""
    second_stage: SecondStage
    """How the crops for `ranges` are cut."""

    def flows(self, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """For each pair (h, w, 2) pixels from the first image to the second, or one of `CAMERA_FAULTS`."""
        ...

    def scenes(self, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """Depth and drones of each image, or one of `CAMERA_FAULTS`."""
        ...

    def ranges(self, crops: Crops) -> RangeEstimates:
        """Range and centre of the drone in the middle of each crop.

        All but the probability may be NaN if that is at most `another_crop_probability`.
        """
        ...


class OneByOne(Networks):
    """Networks that take one image or pair at a time; to inherit from."""

    @abstractmethod
    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """Flow of one `ImagePair`; raises one of `CAMERA_FAULTS`."""

    @abstractmethod
    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """Maps of one `ImageView`; raises one of `CAMERA_FAULTS`."""

    def terminate(self) -> None:
        """Ends every run in progress, from any thread, if that is possible; its caller gets an error."""

    def flows(self, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """See `Networks`."""
        return [outcome(self.flow, *pair) for pair in pairs]

    def scenes(self, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """See `Networks`."""
        return [outcome(self.scene, *view) for view in views]


def outcome(function: Callable[..., T], *arguments: object) -> T | Exception:
    """The return value of a function, or the one of `CAMERA_FAULTS` that it raises."""
    try:
        return function(*arguments)
    except CAMERA_FAULTS as error:
        return error
