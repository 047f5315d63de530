"""Flies a dataset: the pilot's own motion from each pair of frames, beside the true one where poses are known."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flockd.core.config.drone import DroneConfig
from flockd.core.messages import (
    EgoMotion,
    Float32Array,
    Frame,
    FrameSet,
    PilotOutput,
    ReasonKind,
    UInt8Array,
    VehicleState,
)
from flockd.flight.geometry import RigCamera, RigidTransform, ZMap, build_rig, rotation_angle_deg
from flockd.flight.perception import Crop, ImageNetworks, OneByOne, RangeEstimate, SceneMaps
from flockd.flight.pilot import FlockPilot
from flockd.ground.datasets import Dataset, DatasetFrame
from flockd.ground.datasets.dataset import Moment

_FLAT_DEVIATION = 1.0
"""Grey levels of standard deviation under which an image shows nothing: matched with anything, it would stand still."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames, and the camera's motion between them."""

    before: Moment
    after: Moment
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
        """Degrees, and metres between the ends; None without an estimate or without the truth."""
        if self.found is None or self.true is None:
            return None
        rotation = rotation_angle_deg(self.found.rotation.T @ self.true.rotation)
        return rotation, float(np.linalg.norm(self.found.translation - self.true.translation))


def size_of(motion: RigidTransform) -> tuple[float, float]:
    """How far a motion turns, degrees, and goes, metres."""
    return rotation_angle_deg(motion.rotation), float(np.linalg.norm(motion.translation))


class RecordedDepth(OneByOne):
    """The learned perception, with the recorded depth in place of the network's."""

    def __init__(self, learned: ImageNetworks) -> None:
        self.second_stage = learned.second_stage
        self.map_stride = learned.map_stride
        self._learned = learned
        self._depth: ZMap | None = None

    def show(self, depth: ZMap | None) -> None:
        """The depth of the next step's image; None: what is learned."""
        self._depth = depth

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """The learned flow."""
        return self._learned.flow(first, second, labels)

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """The learned drones, and the recorded depth."""
        scene = self._learned.scene(frame, camera, ground)
        return scene if self._depth is None else replace(scene, depth=self._depth)

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """The learned ranges."""
        return self._learned.ranges(crops)


def fly_pairs(
    dataset: Dataset, config: DroneConfig, learned: ImageNetworks, *, stride: int, recorded_depth: bool
) -> Iterator[Pair]:
    """Each frame i with frame i + ``stride``, in order, as a pilot with this configuration sees them.

    ``config`` has the dataset's camera as its only one. As many pilots as the stride take the frames in turns, so that
    each flies with every frame once. Nobody knows the autopilot's attitude and height. Raises DatasetError at a frame
    that is missing or damaged.
    """
    mounted = build_rig(config.rig).cameras[dataset.camera.name]
    perceiver = RecordedDepth(learned)
    pilots = [FlockPilot(config, perceiver) for _ in range(stride)]
    past: deque[tuple[Moment, PilotOutput]] = deque(maxlen=stride)
    for frame in dataset.frames(with_depth=recorded_depth):
        moment = frame.moment
        perceiver.show(frame.depth)
        frames = _frame_set(frame, mounted.name)
        output = pilots[moment.index % stride].step(frames, _unknown_vehicle(moment.time_s))
        if len(past) == stride:
            before, output_before = past[0]
            yield _pair(mounted, before, moment, output_before, output)
        past.append((moment, output))


def _frame_set(frame: DatasetFrame, camera: str) -> FrameSet:
    """Without a frame where its image is all of one colour, as cameras' images are in flight."""
    moment = frame.moment
    if float(frame.image.std(axis=(0, 1)).max()) < _FLAT_DEVIATION:
        return FrameSet(moment.time_s, {})
    return FrameSet(moment.time_s, {camera: Frame(camera, frame.image, moment.time_s, moment.index)})


def _unknown_vehicle(time_s: float) -> VehicleState:
    """There is no autopilot: with `perception.scale: network` the own motion needs none."""
    return VehicleState(time_s, np.eye(3), 0.0)


def _pair(camera: RigCamera, before: Moment, after: Moment, first: PilotOutput, second: PilotOutput) -> Pair:
    ego = second.ego_motion
    if ego is None:
        return Pair(
            before, after, None, None, "; ".join([*_blind(before, first), *_blind(after, second), *_why(second)])
        )
    return Pair(before, after, _of_camera(ego, camera), ego.inliers / ego.pairs, None)


def _blind(moment: Moment, output: PilotOutput) -> list[str]:
    return [f"frame {moment.index}: {reason}" for reason in output.reasons if reason.kind is ReasonKind.CAMERA]


def _why(output: PilotOutput) -> list[str]:
    return [reason.text for reason in output.reasons if reason.kind is not ReasonKind.CAMERA]


def _of_camera(ego: EgoMotion, camera: RigCamera) -> RigidTransform:
    """The body's motion as the camera's."""
    mount = camera.T_body_camera
    return mount.inverse() @ RigidTransform(ego.rotation, ego.translation) @ mount
