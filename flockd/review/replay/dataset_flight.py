"""Replays a dataset: the pilot's ego-motion from pairs of frames, measured against the poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.geometry import GeometryParameters
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.rig import RigConfig
from flockd.core.messages import (
    Float32Array,
    Frame,
    FrameSet,
    PilotOutput,
    ReasonKind,
    UInt8Array,
    VehicleState,
)
from flockd.flight.geometry import (
    RigCamera,
    RigidTransform,
    ZMap,
    build_rig,
    rotation_angle_deg,
)
from flockd.flight.perception import Crops, OneByOne, RangeEstimates, SceneMaps, load_networks
from flockd.flight.pilot import FlockPilot
from flockd.ground.datasets.image_folder import Dataset, DatasetFrame
from flockd.review.flight_log.log import spread

Depth = Literal["recorded", "network"]

_STRIDE_PX = 6
"""Narrower, so that one camera gives as many points as the four of a drone."""


def dataset_config(dataset: Dataset, config: DroneConfig | None, depth: Depth, flow: str | None) -> DroneConfig:
    """The settings of a replay: the dataset's camera, scale by the network, and the flow model that is named.

    ``config``: a drone's; None: settings for a hand-held camera.
    """
    rig = RigConfig(cameras=(dataset.camera,))
    if config is None:
        geometry = GeometryParameters(
            background_stride_px=_STRIDE_PX,
            # The refinement's weights are for a network's depth; a sensor's is better than that.
            refine=depth != "recorded",
        )
        perception = PerceptionConfig(scale="network", flow_refinement="dis")
        config = DroneConfig(rig=rig, geometry=geometry, perception=perception)
    changes = {"scale": "network", "flow": flow or config.perception.flow}
    update = {"rig": rig, "source": None, "perception": config.perception.model_copy(update=changes)}
    return config.model_copy(update=update)


def dataset_result(pairs: Sequence[Pair]) -> dict[str, Any]:
    """The result of a replay as JSON, for `flockd replay --json`."""
    errors = [pair.error for pair in pairs if pair.error]
    scales = [pair.scale for pair in pairs if pair.scale is not None]
    return {
        "pairs": [_pair_result(pair) for pair in pairs],
        "rotation_error_deg": spread([rotation for rotation, _ in errors], "median", "p95", "max"),
        "translation_error_m": spread([translation for _, translation in errors], "median", "p95", "max"),
        "scale": float(np.median(scales)) if scales else None,
        "estimated_ratio": sum(pair.found is not None for pair in pairs) / len(pairs),
    }


def _pair_result(pair: Pair) -> dict[str, Any]:
    true, (rotation_error, translation_error) = pair.true, pair.error or (None, None)
    return {
        "from": pair.before.index,
        "to": pair.after.index,
        "true_rotation_deg": rotation_angle_deg(true.rotation) if true else None,
        "true_translation_m": float(np.linalg.norm(true.translation)) if true else None,
        "rotation_error_deg": rotation_error,
        "translation_error_m": translation_error,
        "inlier_ratio": pair.inlier_ratio,
        "estimated": pair.found is not None,
        "reason": pair.reason,
    }


_FLAT_DEVIATION = 1.0
"""Standard deviation in grey levels below which an image shows nothing: matched with any image, it would seem to stand
still."""

_LEAST_WAY_M = 0.01


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames, and the camera's motion between them."""

    before: DatasetFrame
    after: DatasetFrame
    found: RigidTransform | None
    """``T_before_after`` of the camera, as the pilot found it; None if it did not."""
    inlier_ratio: float | None
    reason: str | None
    """Why there is no estimate."""

    @property
    def true(self) -> RigidTransform | None:
        """``T_before_after`` by the poses; None where one of them is not known."""
        begin, end = self.before.T_world_camera, self.after.T_world_camera
        return begin.inverse() @ end if begin and end else None

    @property
    def error(self) -> tuple[float, float] | None:
        """Errors of the motion in degrees and metres; None without an estimate or without the truth."""
        if self.found is None or self.true is None:
            return None
        rotation = rotation_angle_deg(self.found.rotation.T @ self.true.rotation)
        return rotation, float(np.linalg.norm(self.found.translation - self.true.translation))

    @property
    def scale(self) -> float | None:
        """Length of the motion relative to that by the poses; None without both, or without a motion."""
        if self.found is None or self.true is None or (way := np.linalg.norm(self.true.translation)) < _LEAST_WAY_M:
            return None
        return float(np.linalg.norm(self.found.translation) / way)


class RecordedDepth(OneByOne):
    """The networks' perception, with the recorded depth in place of theirs."""

    def __init__(self, learned: OneByOne) -> None:
        self.second_stage = learned.second_stage
        self.map_stride = learned.map_stride
        self._learned = learned
        self._depth: ZMap | None = None

    def show(self, depth: ZMap | None) -> None:
        """Sets the depth of the next step's image; None: the network's depth is used."""
        self._depth = depth

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """The network's flow."""
        return self._learned.flow(first, second, labels)

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """The network's drones, and the recorded depth."""
        scene = self._learned.scene(frame, camera, ground)
        return scene if self._depth is None else replace(scene, depth=self._depth)

    def ranges(self, crops: Crops) -> RangeEstimates:
        """The network's ranges."""
        return self._learned.ranges(crops)


def replay_dataset(dataset: Dataset, config: DroneConfig, stride: int, depth: Depth) -> Iterator[Pair]:
    """Each frame i with frame i + ``stride``, in order, as a pilot with this configuration sees them.

    ``config`` has the dataset's camera as its only one. As many pilots as the stride take the frames in turns, so that
    each flies with every frame once. Attitude and height are not known: with `perception.scale: network` the own motion
    needs neither. Raises DatasetError at a frame that is missing or damaged, ModelError.
    """
    camera = build_rig(config.rig).cameras[dataset.camera.name]
    mount = camera.T_body_camera
    perceiver = RecordedDepth(load_networks(config.perception))
    pilots = [FlockPilot(config, perceiver) for _ in range(stride)]
    past: deque[tuple[DatasetFrame, PilotOutput]] = deque(maxlen=stride)
    for moment, image, seen in dataset.frames(with_depth=depth == "recorded"):
        perceiver.show(seen)
        frames = {camera.name: Frame(camera.name, image, float(moment.index), moment.index)}
        if float(image.std(axis=(0, 1)).max()) < _FLAT_DEVIATION:
            frames = {}  # as cameras' images of one colour are left out in flight
        vehicle = VehicleState(float(moment.index), np.eye(3), 0.0)
        output = pilots[moment.index % stride].step(FrameSet(float(moment.index), frames), vehicle)
        if len(past) == stride:
            before, output_before = past[0]
            ego = output.ego_motion
            if ego is None:
                reasons = [*_blind(before, output_before), *_blind(moment, output)]
                reasons += [reason.text for reason in output.reasons if reason.kind is not ReasonKind.CAMERA]
                yield Pair(before, moment, None, None, "; ".join(reasons))
            else:
                found = mount.inverse() @ RigidTransform(ego.rotation, ego.translation) @ mount
                yield Pair(before, moment, found, ego.inliers / ego.pairs, None)
        past.append((moment, output))


def _blind(moment: DatasetFrame, output: PilotOutput) -> list[str]:
    return [f"frame {moment.index}: {reason}" for reason in output.reasons if reason.kind is ReasonKind.CAMERA]
