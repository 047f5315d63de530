"""The metric scale of depth, from how far the autopilot says that the drone went between two images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import Float32Array, FloatArray, UInt8Array, VehicleState
from flockd.flight.geometry import Rig, RigCamera, RigidTransform, grid_pixels, inverse_depths
from flockd.flight.perception.depth.scale import Scale, fit_scale
from flockd.flight.perception.maps import SceneMaps


@dataclass(frozen=True)
class VelocityParameters:
    """How depth is triangulated from the autopilot's velocity and the flow."""

    stride_px: int = 8
    """Between pixels that are triangulated."""
    flow_sigma_px: float = 1.0
    min_baseline_m: float = 0.05
    """Across the line of sight; with less between two images, depth by velocity is noise."""
    memory: float = 0.7
    """Of the last factor, in each step: the autopilot's velocity wanders, a network's factor changes slowly."""


DEFAULTS = VelocityParameters()


class VelocityScale:
    """Fixes scales by how far the drone went between two images. Keeps the last while the drone stands."""

    def __init__(self, rig: Rig, parameters: VelocityParameters = DEFAULTS) -> None:
        self._rig, self._parameters = rig, parameters
        self._factor: float | None = None
        """Of a network that knows metres: one for all cameras."""
        self._scales: dict[str, Scale] = {}
        """Of a network that does not: each image has its own."""

    def fix(
        self,
        before: VehicleState | None,
        now: VehicleState,
        labels_before: Mapping[str, UInt8Array],
        maps: Mapping[str, SceneMaps],
        flows: Mapping[str, Float32Array],
    ) -> tuple[dict[str, SceneMaps], list[str]]:
        """The maps with metres, and why some have none.

        Args:
            before: the vehicle when the last images were taken; None: there are none.
            now: the vehicle at ``maps``' time.
            labels_before: by camera, (h, w), 0 for the background.
            maps: by camera; all of one network.
            flows: by camera, from the last image to this one; (h, w, 2) pixels.
        """
        motion = _motion(before, now) if before else None
        samples: dict[str, _Samples] = {}
        for name, flow in flows.items():
            if motion is not None:
                camera, scene = self._rig.cameras[name], maps[name]
                seen = _triangulated(camera, motion, labels_before[name], scene, flow, self._parameters)
                if len(seen.target):
                    samples[name] = seen
        self._learn_factor([s for name, s in samples.items() if not _has_shift(maps[name])])
        for name, seen in samples.items():
            if _has_shift(maps[name]):
                found = fit_scale(seen.open, seen.target, seen.sigma, shift=True)
                self._scales[name] = found or self._scales.get(name) or Scale(1.0)
        fixed, reasons = {}, []
        for name, scene in maps.items():
            scale = self._scales.get(name) if _has_shift(scene) else Scale(self._factor or 1.0)
            fixed[name] = scale.metric(scene) if scale else scene
            if scale is None:
                reasons.append(f"camera {name}: the drone has not yet moved enough for its velocity to fix the scale")
        return fixed, reasons

    def _learn_factor(self, samples: list[_Samples]) -> None:
        if not samples:
            return
        open_, target, sigma = (
            np.concatenate([getattr(sample, part) for sample in samples]) for part in ("open", "target", "sigma")
        )
        found = fit_scale(open_, target, sigma, shift=False)
        if found is None:
            return
        before = found.factor if self._factor is None else self._factor
        memory = self._parameters.memory
        self._factor = float(np.exp(memory * np.log(before) + (1.0 - memory) * np.log(found.factor)))


@dataclass(frozen=True, eq=False)
class _Samples:
    open: FloatArray
    """(n,) what the network says."""
    target: FloatArray
    """(n,) 1/m"""
    sigma: FloatArray
    """(n,) 1/m, standard deviation of the target."""


def _has_shift(maps: SceneMaps) -> bool:
    return maps.open is not None and maps.open.shift


def _motion(before: VehicleState, now: VehicleState) -> RigidTransform | None:
    """From the body now to the body before, as the autopilot says."""
    if before.velocity_ned is None or now.velocity_ned is None:
        return None
    travelled = 0.5 * (before.velocity_ned + now.velocity_ned) * (now.time_s - before.time_s)
    back = before.R_ned_body.T
    return RigidTransform(back @ now.R_ned_body, back @ travelled)


def _triangulated(
    camera: RigCamera,
    motion: RigidTransform,
    labels_before: UInt8Array,
    maps: SceneMaps,
    flow: Float32Array,
    parameters: VelocityParameters,
) -> _Samples:
    """Inverse depth of the background's pixels now, from where they were before; none without a baseline."""
    if maps.open is None:  # a truth in the network's place knows metres
        return _Samples(np.empty(0), np.empty(0), np.empty(0))
    start = grid_pixels(camera.camera.size, parameters.stride_px)
    column, row = start.astype(np.int64).T
    end = start + flow[row, column]
    inside = camera.camera.in_image(end) & (labels_before[row, column] == 0)
    start, end = start[inside], end[inside]
    column, row = end.astype(np.int64).T
    background = maps.labels[row, column] == 0
    start, end, column, row = start[background], end[background], column[background], row[background]
    inverse, baseline = inverse_depths(camera, motion, start, end)
    usable = baseline > parameters.min_baseline_m  # false for NaN: outside a lens's circle there is no ray
    sigma = parameters.flow_sigma_px / camera.camera.focal_px / baseline[usable]
    return _Samples(maps.open.inverse[row, column][usable].astype(np.float64), inverse[usable], sigma)
