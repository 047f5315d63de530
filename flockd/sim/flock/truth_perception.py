"""The truth in the place of chosen networks: to measure how much of an error each of them causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flockd.core.messages import Float32Array, FloatArray, Frame, UInt8Array
from flockd.flight.geometry import Rig, RigCamera, ZMap
from flockd.flight.perception import Crop, ImageNetworks, Instance, OneByOne, RangeEstimate, SceneMaps
from flockd.sim.renderer.renderer import View, true_flow

_SKY_M = 1000.0
_MIN_PIXELS = 10
_SIZE_M = 0.6
"""What the true distances say of every drone's size."""


@dataclass(frozen=True, eq=False)
class RenderTruth:
    """The truth behind one rendered frame set of one drone: ids, depth and poses."""

    rig: Rig
    """As it truly is."""
    views: Mapping[str, View]
    R_ned_cameras: Mapping[str, FloatArray]
    positions: Mapping[str, FloatArray]
    """Positions of the optical centres, NED."""
    R_ned_body: FloatArray
    position: FloatArray
    drone_rotations: FloatArray
    drone_positions: FloatArray
    shown: Sequence[int]


class TruthPerception(OneByOne):
    """Takes the swapped roles from the renderer's truth and all others from the learned perception. One for each drone.

    Call `show` with the truth behind the next frame set before the pilot's step.
    """

    def __init__(self, learned: ImageNetworks, swap: frozenset[str]) -> None:
        self.second_stage = learned.second_stage
        self.map_stride = learned.map_stride
        self._learned, self._swap = learned, swap
        self._now: RenderTruth | None = None
        self._before: RenderTruth | None = None

    def show(self, truth: RenderTruth) -> None:
        """Sets the truth behind the next step's frames."""
        self._before, self._now = self._now, truth

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """The true or the learned flow."""
        if "flow" not in self._swap:
            return self._learned.flow(first, second, labels)
        before, now, camera = _known(self._before), _known(self._now), second.camera
        flow, _ = true_flow(
            before.views[camera], now.views[camera], now.rig.cameras[camera].camera.matrix,
            R_ned_camera=(before.R_ned_cameras[camera], now.R_ned_cameras[camera]),
            position_ned=(before.positions[camera], now.positions[camera]),
            drone_rotations=(before.drone_rotations, now.drone_rotations),
            drone_positions=(before.drone_positions, now.drone_positions),
        )  # fmt: skip
        return flow

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """Depth and drones, each true or learned."""
        now = _known(self._now)
        view = now.views[frame.camera]
        true = SceneMaps(
            depth=ZMap(np.where(np.isfinite(view.depth), view.depth, np.float32(_SKY_M))),
            labels=view.ids,
            instances=tuple(self._instances(camera, now)),
        )
        if {"depth", "segmentation"} <= self._swap:
            return true
        learned = self._learned.scene(frame, camera, ground)
        drones = true if "segmentation" in self._swap else learned
        return replace(drones, depth=true.depth if "depth" in self._swap else learned.depth)

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """The true range of the drone nearest to each crop's middle, or the learned one."""
        if "distance" not in self._swap:
            return self._learned.ranges(crops)
        return tuple(self._range(crop, _known(self._now)) for crop in crops)

    def _instances(self, camera: RigCamera, now: RenderTruth) -> list[Instance]:
        name = camera.name
        ids = now.views[name].ids
        found = []
        for drone in now.shown:
            rows, columns = np.nonzero(ids == drone + 1)
            if rows.size < _MIN_PIXELS:
                continue
            point = now.R_ned_cameras[name].T @ (now.drone_positions[drone] - now.positions[name])
            centre = camera.camera.project(point[None])[0]
            if not np.isfinite(centre).all():
                centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
            box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], np.float64)
            found.append(Instance(drone + 1, centre, box, float(rows.size)))
        return sorted(found, key=lambda one: -one.area_px)

    def _range(self, crop: Crop, now: RenderTruth) -> RangeEstimate:
        size = crop.camera.size[0]
        visible = [d for d in now.shown if any((view.ids == d + 1).sum() >= _MIN_PIXELS for view in now.views.values())]
        if not visible:
            return RangeEstimate(0.0, 1.0, np.full(2, size / 2), _SIZE_M, drone_probability=0.0)
        in_body = (now.drone_positions[visible] - now.position) @ now.R_ned_body
        in_view = crop.T_body_camera.inverse().apply(in_body)
        ranges = np.linalg.norm(in_view, axis=1)
        point = in_view[np.argmax(in_view[:, 2] / ranges)]
        log_range = float(np.log(np.linalg.norm(point)))
        centre = size / 2 + crop.camera.focal_px * point[:2] / max(point[2], 1e-3)
        inside = bool(((centre > 0) & (centre < size)).all())
        return RangeEstimate(log_range, 0.001, np.clip(centre, -size, 2 * size), _SIZE_M, float(inside))


def _known(truth: RenderTruth | None) -> RenderTruth:
    if truth is None:
        raise RuntimeError("the truth of a frame set was needed before `show` was called with it")
    return truth
