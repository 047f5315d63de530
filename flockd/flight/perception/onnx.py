"""The networks that a configuration names, as ONNX models: flow, depth, segmentation, distance and verification."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from flockd.core.choices import Role
from flockd.core.config.perception import NO_MODEL, PerceptionConfig
from flockd.core.errors import ModelError
from flockd.core.messages import BoolArray, Float32Array, FloatArray, Frame, UInt8Array
from flockd.flight.geometry import RigCamera, ZMap
from flockd.flight.inference.fitting import fit
from flockd.flight.inference.manifest_file import manifest_path, models_folder, models_for
from flockd.flight.inference.providers import engines_folder
from flockd.flight.inference.session import Deadline, OnnxModel, no_deadline
from flockd.flight.perception.detection.boxes import BoxRules, kept_boxes, probable_boxes, with_boxes
from flockd.flight.perception.detection.instances import group_instances
from flockd.flight.perception.flow import DisFlow, OnnxFlow, grid_flow
from flockd.flight.perception.interface import Crops, OneByOne, RangeEstimates, SceneMaps, SecondStage

CROPS_PER_RUN = 24
"""Crops in one run of a network, so that an image full of false proposals takes no more memory."""
_WHOLE_PX = 800
"""Longest side of an image in which a detector finds drones of any size."""
_MAX_DEPTH_M = 1e3
"""Largest depth that is taken from an inverse depth: the sky's is about 0, or less."""
_NO_DRONE_LOGIT = np.float32(-50.0)
"""The logit outside the lens's image."""
_MIN_RAY_Z = 0.1
"""Least z of a unit ray, so that its tangents stay finite: 84 degrees from the optical axis."""


def load_networks(config: PerceptionConfig, deadline: Deadline = no_deadline, *, at_once: int = 1) -> OnnxNetworks:
    """The networks that a configuration names; `deadline` is for the golden input of each. Raises ModelError.

    Each of `at_once` images gets its share of the configured threads; the crops of all images get all.
    """
    return OnnxNetworks(config, models_folder(config), deadline, at_once)


class OnnxNetworks(OneByOne):
    """The networks that a configuration names. Stateless: several pilots may share them."""

    def __init__(
        self, config: PerceptionConfig, models_dir: Path, deadline: Deadline = no_deadline, at_once: int = 1
    ) -> None:
        """See `load_networks`. Raises ModelError."""
        share = max(1, config.threads // at_once)
        self._models = _Models(config, models_dir, deadline, share)
        self._flow_refinement = config.flow_refinement
        cv2.setNumThreads(share)
        self._flow = self._build_flow(config)
        self._depth = self._models.open(config.depth, "depth")
        if config.scale == "height" and "geometry" not in self._depth.manifest.contents:
            raise ModelError(
                f"perception.scale: depth model {config.depth!r} takes no height, as it has no input `geometry`; write "
                "network, which takes its depth as it is, or choose another model"
            )
        self._segmentation = self._models.open(config.segmentation, "segmentation")
        self._distance = self._models.open(config.distance, "distance")
        self._detector = None if config.detector == NO_MODEL else self._models.open(config.detector, "detector")
        self._box_rules = None if self._detector is None else BoxRules.of(self._detector.manifest)
        has_verification = config.verification != NO_MODEL
        self._verification = self._models.open(config.verification, "verification") if has_verification else None
        self.map_stride = self._segmentation.manifest.map_stride or 1
        verification = None if self._verification is None else self._verification.manifest
        self.second_stage = SecondStage.of(self._distance.manifest, verification)

    def terminate(self) -> None:
        """Ends every run in progress; its caller gets an error."""
        self._models.terminate()

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """See `Networks`."""
        before, after = first.image, second.image
        flow = self._flow.flow(before, after)
        return grid_flow(flow, before, after, labels) if self._flow_refinement == "lucas_kanade" else flow

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """See `Networks`."""
        height, width = frame.image.shape[:2]
        planes = geometry_planes(camera, ground, self.map_stride)
        maps = self._run(self._depth, frame.image, planes)
        depth = np.asarray(
            cv2.resize(maps["depth"][0], (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.float32
        )
        if self._segmentation is not self._depth:
            maps = self._run(self._segmentation, frame.image, planes)
        logit = self._at_map_stride(maps["drone"], (width, height))[0]
        logit = np.where(_blind(camera, self.map_stride), _NO_DRONE_LOGIT, logit)
        offset = self._at_map_stride(maps["offset"], (width, height))
        proposal = self._segmentation.manifest.thresholds["proposal_logit"]
        labels, instances = group_instances(logit - np.float32(proposal), offset, scale=self.map_stride)
        labels = np.asarray(cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        if self._detector is not None and self._box_rules is not None:
            boxes, odds = self._boxes(self._detector, self._box_rules, frame.image, camera)
            labels, instances = with_boxes(labels, instances, boxes, odds, self._box_rules)
        return SceneMaps(self._depth_of(depth, camera), labels, instances)

    def ranges(self, crops: Crops) -> RangeEstimates:
        """See `Networks`."""
        estimates, images = RangeEstimates.unknown(len(crops)), crops.images
        if not len(crops):
            return estimates
        if crops.mirrored.any():
            images = np.where(crops.mirrored[:, None, None, None], images[:, :, ::-1], images)
        logits, limit = crops.evidence, math.inf
        if self._verification is not None:
            outputs = _in_batches(self._verification, images)["drone"]
            logits = logits + self._verification.manifest.results["drone"].by_column(outputs)["drone_logit"]
            judge = self._verification if self._detector is None else self._detector
            limit = judge.manifest.thresholds["distance_logit_limit"]
        # Without a drone no range is needed: most crops of a cluttered image end here.
        most = _probability(logits + limit)
        rest = (most > self.second_stage.another_crop_probability).nonzero()[0]
        estimates.centre[:], estimates.drone_probability[:] = self.second_stage.crop_size / 2, most
        if len(rest):
            ranged = self._ranges(crops[rest], images[rest], logits[rest], limit)
            for column, values in zip(estimates, ranged, strict=True):
                column[rest] = values
        return estimates

    def _ranges(self, crops: Crops, images: UInt8Array, logits: FloatArray, limit: float) -> RangeEstimates:
        """The distance network's estimates from crops, given their images as its input.

        Its own log odds of a drone are added to ``logits`` (n,), up to ``limit``: log odds of independent evidence add.
        """
        outputs = _in_batches(self._distance, images)["range"]
        columns = self._distance.manifest.results["range"].by_column(outputs)
        values = {name: np.asarray(column, np.float64) for name, column in columns.items()}
        evidence = logits + np.clip(values["drone_logit"], -limit, limit)
        right = np.where(crops.mirrored, -values["right_px"], values["right_px"])  # mirrored back
        size_sigma = np.exp(values.get("log_size_sigma", np.full(len(crops), -np.inf)))
        return RangeEstimates(
            log_range=values["log_range_per_focal"] + np.log(crops.focal_px),
            log_range_sigma=np.exp(values["log_relative_sigma"]),
            centre=np.array([right, values["down_px"]]).T + self.second_stage.crop_size / 2,
            size_m=np.exp(values["log_range_per_focal"] + values["log_apparent_size"]),
            drone_probability=_probability(evidence),
            log_size_sigma=np.minimum(size_sigma, _MOST_SIZE_SIGMA),
        )

    def _boxes(
        self, detector: OnnxModel, rules: BoxRules, image: UInt8Array, camera: RigCamera
    ) -> tuple[FloatArray, FloatArray]:
        """Boxes (n, 4) of drones, left, top, right, bottom in pixels of the image, and their log odds (n,).

        A large image is also searched at half its size, and so on: a drone may be larger than the network can see.
        """
        seen, scale, found = image, 1.0, []
        while True:
            fitting = fit(detector.manifest, (seen.shape[1], seen.shape[0]))
            rows = detector.infer({"image": [fitting.enter(seen)]})["boxes"]
            columns = detector.manifest.results["boxes"].by_column(rows)
            found.append(probable_boxes(columns, rules, (scale * fitting.scale[0], scale * fitting.scale[1])))
            if max(seen.shape[:2]) <= _WHOLE_PX:
                break
            scale /= 2
            seen = np.asarray(cv2.resize(seen, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        boxes, odds = kept_boxes(
            np.concatenate([one for one, _ in found]), np.concatenate([p for _, p in found]), rules
        )
        inside = camera.camera.in_image((boxes[:, :2] + boxes[:, 2:]) / 2)
        return boxes[inside], odds[inside]

    def _run(self, model: OnnxModel, image: UInt8Array, planes: Float32Array) -> dict[str, Float32Array]:
        """One model's maps (c, h, w) of a whole image, at the model's resolution."""
        fitting = fit(model.manifest, (image.shape[1], image.shape[0]))
        contents: dict[str, Sequence[UInt8Array] | Float32Array] = {"image": [fitting.enter(image)]}
        if "geometry" in model.manifest.contents:
            contents["geometry"] = fitting.enter_planes(planes, self.map_stride)[None]
        return {name: fitting.inside(map_)[0] for name, map_ in model.infer(contents).items()}

    def _at_map_stride(self, maps: Float32Array, image: tuple[int, int]) -> Float32Array:
        """(c, h, w) at the resolution of the segmentation; two channels are offsets in map pixels."""
        width, height = image[0] // self.map_stride, image[1] // self.map_stride
        if maps.shape[1:] == (height, width):
            return maps
        resized = np.array([cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR) for plane in maps])
        if len(maps) == 2:
            resized *= np.array([width / maps.shape[2], height / maps.shape[1]], np.float32)[:, None, None]
        return np.asarray(resized, dtype=np.float32)

    def _depth_of(self, depth: Float32Array, camera: RigCamera) -> ZMap:
        """Metric depth from the network's output, resized."""
        meaning = self._depth.manifest.results["depth"].depth
        is_inverse = meaning.quantity == "inverse_depth"
        if meaning.focal_px:
            size = (depth.shape[1], depth.shape[0])
            longer = fit(self._depth.manifest, size).scale[0] * camera.camera.focal_px / meaning.focal_px
            depth = depth / longer if is_inverse else depth * longer
        metres = 1.0 / np.maximum(depth, 1.0 / _MAX_DEPTH_M) if is_inverse else depth
        return ZMap(np.asarray(metres, np.float32))

    def _build_flow(self, config: PerceptionConfig) -> DisFlow | OnnxFlow:
        if config.flow == "dis":
            return DisFlow()
        network = OnnxFlow(self._models.open(config.flow, "flow"))
        return DisFlow(network) if config.flow_refinement == "dis" else network


_OF_CROPS = frozenset({"distance", "verification"})
"""Roles that process the crops of all images, in one batch."""


class _Models:
    """Opens each model once, however many roles it fills."""

    def __init__(self, config: PerceptionConfig, folder: Path, deadline: Deadline, share: int) -> None:
        """``share``: threads of models that process single images."""
        self._config, self._folder, self._deadline, self._share = config, folder, deadline, share
        self._opened: dict[Path, OnnxModel] = {}

    def open(self, name: str, role: Role) -> OnnxModel:
        """The model for a role. Raises ModelError if it is missing or does not fill the role."""
        path = manifest_path(self._folder, name)
        if path not in self._opened:
            if not path.is_file():
                raise ModelError(f"perception.{role}: {_what_to_name_instead(name, role, path, self._folder)}")
            self._opened[path] = OnnxModel(
                path,
                threads=self._config.threads if role in _OF_CROPS else self._share,
                provider=self._config.provider,
                engines=engines_folder(self._config),
                deadline=self._deadline,
            )
        model = self._opened[path]
        if role not in model.manifest.roles:
            raise ModelError(
                f"perception.{role}: model {name!r} fills {', '.join(model.manifest.roles)} and not {role}; "
                f"{_one_of(role, self._folder)}"
            )
        return model

    def terminate(self) -> None:
        """Ends every run in progress."""
        for model in self._opened.values():
            model.terminate()


def _what_to_name_instead(name: str, role: Role, path: Path, folder: Path) -> str:
    if name.endswith(".onnx"):
        return f"{name} is a model's ONNX file; name the manifest beside it, {Path(name).with_suffix('.yaml')}"
    if "/" in name and not name.endswith(".yaml"):
        return f"{name!r} is no model's name, and no manifest; name the manifest, as in {Path(name) / role}.yaml"
    return f"there is no model {name!r} ({path} is missing); {_one_of(role, folder)}"


def _one_of(role: Role, folder: Path) -> str:
    known = models_for(role, folder)
    return f"choose one of {', '.join(known)}" if known else "name another"


def _in_batches(model: OnnxModel, images: UInt8Array) -> dict[str, Float32Array]:
    """A model's outputs (n, ...) for all crops."""
    batches = [images[i : i + CROPS_PER_RUN] for i in range(0, len(images), CROPS_PER_RUN)]
    outputs = [model.infer({"crop": batch}) for batch in batches]
    return {name: np.concatenate([output[name] for output in outputs]) for name in outputs[0]}


def _probability(logit: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-logit)))


_MOST_SIZE_SIGMA = 0.5
"""Largest sigma of log size: twice it is a factor of 2.7 either way, which means that nothing is known."""


def geometry_planes(camera: RigCamera, ground: Float32Array | None, stride: int) -> Float32Array:
    """(3, h / stride, w / stride): tangents of the rays right and down, inverse depth of flat ground (0: none)."""
    tangents = _ray_tangents(camera, stride)
    flat = np.zeros(tangents.shape[1:], np.float32) if ground is None else ground
    return np.concatenate([tangents, flat[None]])


@lru_cache(maxsize=32)
def _ray_tangents(camera: RigCamera, stride: int) -> Float32Array:
    """(2, h / stride, w / stride) tangents of the rays of the blocks' centres, right and down from the optical axis."""
    rays = np.nan_to_num(camera.camera.block_rays(stride))  # outside the lens's image
    tangents = rays[..., :2] / np.maximum(rays[..., 2:], _MIN_RAY_Z)
    return np.ascontiguousarray(tangents.transpose(2, 0, 1), dtype=np.float32)


@lru_cache(maxsize=32)
def _blind(camera: RigCamera, stride: int) -> BoolArray:
    """(h / stride, w / stride) mask of the blocks whose centres the lens does not image."""
    return np.isnan(camera.camera.block_rays(stride)[..., 0])
