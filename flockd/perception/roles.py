"""The four roles that perception fills, and the models behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flockd.config.parameters import PerceptionConfig
from flockd.errors import ModelError
from flockd.messages import Float32Array, FloatArray, UInt8Array
from flockd.perception.flow import DisFlow, Flow, OnnxFlow
from flockd.perception.instances import UNSURE, Instance, group_instances
from flockd.perception.manifest import Role, manifest_path
from flockd.perception.session import OnnxModel

_EAGER_LOGIT = -1.5
"""Where a second stage weeds out what is none, the first proposes drones from this logit up."""


@dataclass(frozen=True, eq=False)
class SceneMaps:
    """What the networks say of one image."""

    depth: Float32Array
    """(h, w) metres along the optical axis; the sky is very far."""
    labels: UInt8Array
    """(h, w) 0 for background, then one value a drone; ``UNSURE`` for the part of a drone that may be background."""
    instances: tuple[Instance, ...]


@dataclass(frozen=True, eq=False)
class Picture:
    """What a small virtual pinhole camera that faces one drone sees."""

    image: UInt8Array
    """(size, size, 3) RGB"""
    focal_px: float
    R_body_camera: FloatArray
    position: FloatArray
    """(3,) of its optical centre in the body, metres."""


@dataclass(frozen=True, eq=False)
class RangeEstimate:
    """What the second stage says of one picture."""

    range_m: float
    relative_sigma: float
    """Standard deviation of the range, as a share of it."""
    centre: FloatArray
    """(2,) u, v of the drone's centre in the picture."""
    size_m: float
    """The drone's size from tip to tip; errs like the range does, but is the same in every picture of one drone."""
    is_drone: float = 1.0
    """Probability that there is a drone at all."""


class Perception:
    """The networks of one configuration. Stateless: may serve several pilots."""

    picture_size = 96
    map_scale = 2
    """Image pixels per pixel of the geometry planes that ``scene`` takes."""

    def __init__(self, config: PerceptionConfig, models_dir: Path) -> None:
        self._models: dict[str, OnnxModel] = {}
        self._dir = models_dir
        self._threads = config.threads
        cv2.setNumThreads(config.threads)
        self._flow = self._build_flow(config)
        self._depth = self._model(config.depth, "depth")
        self._segmentation = self._model(config.segmentation, "segmentation")
        self._distance = None if config.distance == "none" else self._model(config.distance, "distance")

    @property
    def has_distance(self) -> bool:
        """Whether there is a second stage."""
        return self._distance is not None

    def terminate(self) -> None:
        """Ends every run of a network that is under way; whoever called it gets an error."""
        for model in self._models.values():
            model.terminate()

    def flow(self, camera: str, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 2) pixels from the first image to the second."""
        return self._flow.flow(first, second)

    def scene(self, camera: str, image: UInt8Array, geometry: Float32Array) -> SceneMaps:
        """Depth and drones of one image.

        ``geometry`` is (3, h/2, w/2): ray tangents right and down, and the inverse depth (1/m) of flat ground where
        attitude and height are to fix the scale, else 0.
        """
        height, width = image.shape[:2]
        padded, planes = _pad(image, geometry, self._depth.manifest.size_multiple)
        outputs = self._depth.run({"image": padded[None], "geometry": planes[None]})
        depth = outputs["depth"][0, 0, : height // 2, : width // 2]
        if self._segmentation is not self._depth:
            outputs = self._segmentation.run({"image": padded[None], "geometry": planes[None]})
        logit = outputs["drone"][0, 0, : height // 2, : width // 2]
        offset = outputs["offset"][0, :, : height // 2, : width // 2]
        threshold = _EAGER_LOGIT if self.has_distance else 0.0
        labels, instances = group_instances(logit - np.float32(threshold), offset, scale=self.map_scale)
        labels[(labels > 0) & (logit < 0)] = UNSURE
        size = (width, height)
        return SceneMaps(
            np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32),
            np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8),
            instances,
        )

    def ranges(self, pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        """The second stage: range and centre of the drone in the middle of each picture."""
        if self._distance is None:
            raise ValueError("this configuration has no distance model")
        if not pictures:
            return ()
        (out,) = self._distance.run({"picture": np.stack([picture.image for picture in pictures])}).values()
        middle = self.picture_size / 2
        return tuple(
            RangeEstimate(
                range_m=float(np.exp(row[0]) * picture.focal_px),
                relative_sigma=float(np.exp(row[3])),
                centre=np.array([middle + row[1], middle + row[2]], np.float64),
                size_m=float(np.exp(row[0] + row[5])),
                is_drone=float(1.0 / (1.0 + np.exp(-row[4]))),
            )
            for row, picture in zip(out, pictures, strict=True)
        )

    def _build_flow(self, config: PerceptionConfig) -> Flow:
        if config.flow == "dis":
            return DisFlow()
        network = OnnxFlow(self._model(config.flow, "flow"))
        return DisFlow(network) if config.flow_refinement == "dis" else network

    def _model(self, name: str, role: Role) -> OnnxModel:
        path = manifest_path(self._dir, name)
        key = str(path)
        if key not in self._models:
            if not path.is_file():
                raise ModelError(
                    f"perception.{role}: there is no model {name!r} ({path} is missing); "
                    f"choose one of {', '.join(sorted(p.stem for p in self._dir.glob('*.yaml'))) or 'none at hand'}"
                )
            self._models[key] = OnnxModel(path, threads=self._threads)
        model = self._models[key]
        if role not in model.manifest.roles:
            raise ModelError(
                f"perception.{role}: model {name!r} fills {', '.join(model.manifest.roles)} and not {role}; "
                "choose another"
            )
        return model


def _pad(image: UInt8Array, geometry: Float32Array, multiple: int) -> tuple[UInt8Array, Float32Array]:
    down, right = -image.shape[0] % multiple, -image.shape[1] % multiple
    if not down and not right:
        return image, geometry
    padded = np.pad(image, ((0, down), (0, right), (0, 0)), mode="edge")
    return padded, np.pad(geometry, ((0, 0), (0, down // 2), (0, right // 2)), mode="edge")
