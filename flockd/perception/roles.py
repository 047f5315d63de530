"""The four roles that perception fills, and the models behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from flockd.config.perception import PerceptionConfig
from flockd.errors import ModelError
from flockd.inference.fitting import fit
from flockd.inference.manifest import Answer, Content, Role, Unknown, manifest_path
from flockd.inference.providers import engines_folder
from flockd.inference.session import OnnxModel
from flockd.messages import BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.perception.flow import DisFlow, Flow, OnnxFlow, background_flow, object_flow
from flockd.perception.instances import Instance, group_instances

_EAGER_LOGIT = -1.5
"""Where a second stage weeds out what is none, the first proposes drones from this logit up."""
_SURE_LOGIT = 0.4
"""Where pixels count as a drone's, of those it has proposed: its masks are a little too wide."""
PICTURES_AT_A_TIME = 24
"""Pictures in one run of the distance network, so that an image full of ghosts does not take more memory."""
_VERY_NEAR_M, _VERY_FAR_M = 1e-3, 1e3


@dataclass(frozen=True, eq=False)
class OpenDepth:
    """What a network says of depth while its scale is open."""

    inverse: Float32Array
    """(h, w): a factor makes 1/m of it."""
    shift: bool
    """Whether something has to be added as well: the inverse depth is known up to scale and shift."""


@dataclass(frozen=True, eq=False)
class SceneMaps:
    """What the networks say of one image."""

    depth: Float32Array
    """(h, w) metres along the optical axis; the sky is very far. All NaN while the scale is open."""
    labels: UInt8Array
    """(h, w) 0 for background, then one value a drone."""
    instances: tuple[Instance, ...]
    open: OpenDepth | None = None
    """What is there instead of metres, for `flockd.perception.depth` to fix."""
    unsure: BoolArray | None = None
    """(h, w) which pixels of the drones may just as well be background; None: no such."""
    logit: Float32Array | None = None
    """(h, w) / `Perception.map_scale`, of each pixel being any drone's; None: the labels are all that is known."""


@dataclass(frozen=True, eq=False)
class Picture:
    """What a small virtual pinhole camera that faces one drone sees."""

    image: UInt8Array
    """(size, size, 3) RGB"""
    focal_px: float
    R_body_camera: FloatArray
    position: FloatArray
    """(3,) of its optical centre in the body, metres."""
    in_mirror: bool = False
    """Whether the network is to be shown the mirror image, which it errs on differently. The answer is told as if not.
    """


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
    mask: Float32Array | None = None
    """(size, size) logit of each pixel of the picture being that drone's; None: the model does not say."""


class Perception:
    """The networks of one configuration. Stateless: may serve several pilots."""

    picture_size = 96
    map_scale = 2
    """Image pixels per pixel of the geometry planes that ``scene`` takes."""

    def __init__(self, config: PerceptionConfig, models_dir: Path) -> None:
        self._models: dict[str, OnnxModel] = {}
        self._dir = models_dir
        self._config = config
        cv2.setNumThreads(config.threads)
        self._flow = self._build_flow(config)
        self._depth = self._model(config.depth, "depth")
        self._segmentation = self._model(config.segmentation, "segmentation")
        self._unknown = self._what_is_unknown(config)
        self._distance = None if config.distance == "none" else self._model(config.distance, "distance")

    @property
    def has_distance(self) -> bool:
        """Whether there is a second stage."""
        return self._distance is not None

    def terminate(self) -> None:
        """Ends every run of a network that is under way; whoever called it gets an error."""
        for model in self._models.values():
            model.terminate()

    def flow(self, camera: str, first: UInt8Array, second: UInt8Array, labels: UInt8Array) -> Float32Array:
        """(h, w, 2) pixels from the first image to the second.

        ``labels`` (h, w) of the first image: one value a drone, 0 and 255 none. Each drone's flow is found by itself.
        """
        flow = self._flow.flow(first, second)
        if self._config.flow_refinement == "quick_dis":
            flow = background_flow(flow, first, second, labels)
        return object_flow(flow, first, second, labels)

    def scene(self, camera: str, image: UInt8Array, geometry: Float32Array) -> SceneMaps:
        """Depth and drones of one image.

        ``geometry`` is (3, h/2, w/2): ray tangents right and down, and the inverse depth (1/m) of flat ground where
        attitude and height are to fix the scale, else 0.
        """
        size = (image.shape[1], image.shape[0])
        answers = self._look(self._depth, image, geometry)
        depth = np.asarray(cv2.resize(answers["depth"][0], size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)
        if self._segmentation is not self._depth:
            answers = self._look(self._segmentation, image, geometry)
        logit, offset = self._at_map_scale(answers["drone"], size)[0], self._at_map_scale(answers["offset"], size)
        eager, sure = (_EAGER_LOGIT, _SURE_LOGIT) if self.has_distance else (0.0, 0.0)
        labels, instances = group_instances(logit - np.float32(eager), offset, scale=self.map_scale)
        labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        unsure = cv2.resize((logit < sure).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        maps = self._maps(depth, labels, instances, geometry)
        return replace(maps, unsure=unsure & (labels > 0), logit=logit)

    def ranges(self, pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        """The second stage: range and centre of the drone in the middle of each picture."""
        if self._distance is None:
            raise ValueError("this configuration has no distance model")
        if not pictures:
            return ()
        shown = [np.ascontiguousarray(p.image[:, ::-1]) if p.in_mirror else p.image for p in pictures]
        answers = [
            self._distance.answer({"picture": shown[i : i + PICTURES_AT_A_TIME]})
            for i in range(0, len(shown), PICTURES_AT_A_TIME)
        ]
        out = np.concatenate([answer["range"] for answer in answers])
        masks: Sequence[Float32Array | None] = [None] * len(pictures)
        if "mask" in answers[0]:
            masks = [
                np.ascontiguousarray(m[:, ::-1]) if p.in_mirror else m
                for p, m in zip(pictures, _masks(answers), strict=True)
            ]
        out[[p.in_mirror for p in pictures], 1] *= -1.0
        middle = self.picture_size / 2
        return tuple(
            RangeEstimate(
                range_m=float(np.exp(row[0]) * picture.focal_px),
                relative_sigma=float(np.exp(row[3])),
                centre=np.array([middle + row[1], middle + row[2]], np.float64),
                size_m=float(np.exp(row[0] + row[5])),
                is_drone=float(1.0 / (1.0 + np.exp(-row[4]))),
                mask=mask,
            )
            for row, picture, mask in zip(out, pictures, masks, strict=True)
        )

    def _look(self, model: OnnxModel, image: UInt8Array, geometry: Float32Array) -> dict[Answer, Float32Array]:
        """What one model says of an image: maps (c, h, w) that show all of it, at the model's resolution."""
        fitting = fit(model.manifest, (image.shape[1], image.shape[0]))
        contents: dict[Content, Sequence[UInt8Array] | Float32Array] = {"image": [fitting.enter(image)]}
        if "geometry" in model.manifest.contents:
            contents["geometry"] = fitting.enter_planes(geometry, self.map_scale)[None]
        return {name: fitting.inside(map_)[0] for name, map_ in model.answer(contents).items()}

    def _at_map_scale(self, maps: Float32Array, image: tuple[int, int]) -> Float32Array:
        """(c, h, w) at the resolution that drones are told apart in; two channels are pixels of the map."""
        width, height = image[0] // self.map_scale, image[1] // self.map_scale
        if maps.shape[1:] == (height, width):
            return maps
        resized = np.stack([cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR) for plane in maps])
        if len(maps) == 2:
            resized *= np.array([width / maps.shape[2], height / maps.shape[1]], np.float32)[:, None, None]
        return np.asarray(resized, dtype=np.float32)

    def _maps(
        self, depth: Float32Array, labels: UInt8Array, instances: tuple[Instance, ...], geometry: Float32Array
    ) -> SceneMaps:
        """With metres of what the depth network says, or with what it leaves open."""
        meaning = self._depth.manifest.answers["depth"].depth
        is_inverse = meaning.quantity == "inverse_depth"
        if meaning.focal_px:
            size = (depth.shape[1], depth.shape[0])
            longer = fit(self._depth.manifest, size).scale[0] * _focal_px(geometry, self.map_scale) / meaning.focal_px
            depth = depth / longer if is_inverse else depth * longer
        if self._unknown == "nothing":
            metres = 1.0 / np.maximum(depth, 1.0 / _VERY_FAR_M) if is_inverse else depth
            return SceneMaps(np.asarray(metres, np.float32), labels, instances)
        inverse = depth if is_inverse else 1.0 / np.maximum(depth, _VERY_NEAR_M)
        open_ = OpenDepth(np.asarray(inverse, np.float32), shift=self._unknown == "scale_and_shift")
        return SceneMaps(np.full_like(depth, np.nan), labels, instances, open_)

    def _what_is_unknown(self, config: PerceptionConfig) -> Unknown:
        """What of the depth is left for the autopilot's height or velocity to fix. Raises ModelError."""
        manifest = self._depth.manifest
        unknown = manifest.answers["depth"].depth.unknown
        if config.scale == "network" and unknown != "nothing":
            raise ModelError(
                f"perception.scale: depth model {config.depth!r} knows no metres, so `network` cannot give the scale; "
                "write height or velocity, or choose a metric model"
            )
        takes_ground = "geometry" in manifest.contents
        if unknown == "nothing" and (config.scale == "velocity" or (config.scale == "height" and not takes_ground)):
            return "scale"
        return unknown

    def _build_flow(self, config: PerceptionConfig) -> Flow:
        if config.flow == "dis":
            return DisFlow()
        network = OnnxFlow(self._model(config.flow, "flow"))
        if config.flow_refinement == "none":
            return network
        return DisFlow(network, config.flow_refinement_scale, quick=config.flow_refinement == "quick_dis")

    def _model(self, name: str, role: Role) -> OnnxModel:
        path = manifest_path(self._dir, name)
        key = str(path)
        if key not in self._models:
            if not path.is_file():
                raise ModelError(
                    f"perception.{role}: there is no model {name!r} ({path} is missing); "
                    f"choose one of {', '.join(sorted(p.stem for p in self._dir.glob('*.yaml'))) or 'none at hand'}"
                )
            self._models[key] = OnnxModel(
                path,
                threads=self._config.threads,
                provider=self._config.provider,
                engines=engines_folder(self._config),
            )
        model = self._models[key]
        if role not in model.manifest.roles:
            raise ModelError(
                f"perception.{role}: model {name!r} fills {', '.join(model.manifest.roles)} and not {role}; "
                "choose another"
            )
        return model


def _masks(answers: Sequence[Mapping[Answer, Float32Array]]) -> Float32Array:
    return np.concatenate([answer["mask"][:, 0] for answer in answers])


def _focal_px(geometry: Float32Array, stride: int) -> float:
    """Of the image, from how fast the rays' tangents change in its middle."""
    row, column = geometry.shape[1] // 2, geometry.shape[2] // 2
    return float(2 * stride / (geometry[0, row, column + 1] - geometry[0, row, column - 1]))
