"""The metric scale of depth that a network leaves open, fixed by the autopilot's height or by its velocity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flockd.geometry import Rig, RigCamera, RigidTransform, grid_pixels
from flockd.messages import Float32Array, FloatArray, UInt8Array, VehicleState
from flockd.perception.maps import SceneMaps

_DRAWS = 200
_MOST_PIXELS = 3000
_AGREEMENT = 0.1
"""Of the inverse depth: what is nearer to a scale than that agrees with it."""
_LEAST_SHARE = 0.25
"""Of the pixels that have to agree: on a plain with trees and houses about half is ground."""
_LEAST_PIXELS = 100
_FARTHEST_GROUND_M = 40.0
"""Flat ground beyond is a few rows under the horizon: a degree of attitude moves it by half."""
_STRIDE_PX = 8
_FLOW_SIGMA_PX = 1.0
_LEAST_BASELINE_M = 0.05
"""Across the line of sight; with less between two images, depth by velocity is noise."""
_MEMORY = 0.7
"""Of the last factor, in each step: the autopilot's velocity wanders, a network's factor changes slowly."""
_VERY_FAR_M = 1e3


@dataclass(frozen=True)
class Scale:
    """``inverse depth = factor * open + shift``, in 1/m."""

    factor: float
    shift: float = 0.0

    def metric(self, maps: SceneMaps) -> SceneMaps:
        """The maps with metres; as they are where nothing is open."""
        if maps.open is None:
            return maps
        inverse = np.float32(self.factor) * maps.open.inverse + np.float32(self.shift)
        depth = 1.0 / np.maximum(inverse, np.float32(1.0 / _VERY_FAR_M))
        return replace(maps, depth=np.asarray(depth, np.float32), open=None)


def fix_by_height(maps: SceneMaps, ground: Float32Array) -> SceneMaps:
    """The maps with metres, from the inverse depth of flat ground (h/stride, w/stride), 1/m, 0 where there is none.

    The scale is the one that brings most of the image's lower part onto the ground. Raises ValueError where too little
    of the image is ground.
    """
    if maps.open is None:
        return maps
    (height, width), stride = ground.shape, maps.labels.shape[0] // ground.shape[0]
    blocks = (height, stride, width, stride)
    level = (ground > 1.0 / _FARTHEST_GROUND_M) & (maps.labels.reshape(blocks).max(axis=(1, 3)) == 0)
    open_ = maps.open.inverse.reshape(blocks).mean(axis=(1, 3))[level]
    scale = _most_agreed(open_, ground[level], np.zeros(len(open_)), shift=maps.open.shift)
    if scale is None:
        raise ValueError("too little flat ground is in view to fix the scale of depth")
    return scale.metric(maps)


class VelocityScale:
    """Fixes scales by how far the drone went between two images. Remembers what it found while the drone stands."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
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
                seen = _triangulated(camera, motion, labels_before[name], scene, flow)
                if len(seen.target):
                    samples[name] = seen
        self._learn_factor([s for name, s in samples.items() if not _has_shift(maps[name])])
        for name, seen in samples.items():
            if _has_shift(maps[name]):
                found = _most_agreed(seen.open, seen.target, seen.sigma, shift=True)
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
        found = _most_agreed(open_, target, sigma, shift=False)
        if found is None:
            return
        before = found.factor if self._factor is None else self._factor
        self._factor = float(np.exp(_MEMORY * np.log(before) + (1.0 - _MEMORY) * np.log(found.factor)))


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
    camera: RigCamera, motion: RigidTransform, labels_before: UInt8Array, maps: SceneMaps, flow: Float32Array
) -> _Samples:
    """Inverse depth of the background's pixels now, from where they were before; none without a baseline."""
    if maps.open is None:  # a truth in the network's place knows metres
        return _Samples(np.empty(0), np.empty(0), np.empty(0))
    start = grid_pixels(camera.camera.size, _STRIDE_PX)
    column, row = start.astype(np.int64).T
    end = start + flow[row, column]
    inside = camera.camera.in_image(end) & (labels_before[row, column] == 0)
    start, end = start[inside], end[inside]
    column, row = end.astype(np.int64).T
    background = maps.labels[row, column] == 0
    start, end, column, row = start[background], end[background], column[background], row[background]
    between = camera.T_body_camera.inverse() @ motion @ camera.T_body_camera
    # p is parallel to R q / w + t, so that p x R q + w (p x t) = 0: linear in w, and honest about noise around zero.
    p = camera.camera.rays(start)
    turned = camera.camera.unproject(end, np.ones(len(end))) @ between.rotation.T
    across, parallax = np.cross(p, between.translation), np.cross(p, turned)
    baseline = np.linalg.norm(across, axis=1)
    usable = baseline > _LEAST_BASELINE_M  # false for NaN: outside a lens's circle there is no ray
    inverse = -(parallax * across).sum(axis=1)[usable] / baseline[usable] ** 2
    sigma = _FLOW_SIGMA_PX / camera.camera.focal_px / baseline[usable]
    return _Samples(maps.open.inverse[row, column][usable].astype(np.float64), inverse, sigma)


def _most_agreed(
    open_: FloatArray | Float32Array, target: FloatArray | Float32Array, sigma: FloatArray, *, shift: bool
) -> Scale | None:
    """The scale that most pixels agree with, fitted to those; None where too few do.

    In the manner of RANSAC: what stands on the ground, moves by itself or was matched falsely does not count.
    """
    finite = np.isfinite(open_) & np.isfinite(target)
    x, y, spread = open_[finite].astype(np.float64), target[finite].astype(np.float64), sigma[finite]
    random = np.random.default_rng(0)
    if len(x) > _MOST_PIXELS:
        drawn = random.choice(len(x), _MOST_PIXELS, replace=False)
        x, y, spread = x[drawn], y[drawn], spread[drawn]
    if len(x) < _LEAST_PIXELS:
        return None
    tolerance = np.maximum(_AGREEMENT * np.abs(y), 2.0 * spread)
    factors, shifts = _candidates(x, y, random, shift=shift)
    if not len(factors):
        return None
    near = np.abs(factors[:, None] * x + shifts[:, None] - y) < tolerance
    agreeing = near[int(np.argmax(near.sum(axis=1)))]
    if agreeing.sum() < max(_LEAST_SHARE * len(x), _LEAST_PIXELS):
        return None
    columns = [x[agreeing], np.ones(int(agreeing.sum()))] if shift else [x[agreeing]]
    weights = 1.0 / np.maximum(tolerance[agreeing], 1e-6)
    design = np.stack(columns, axis=1) * weights[:, None]
    solution = np.linalg.lstsq(design, y[agreeing] * weights, rcond=None)[0]
    return Scale(*(float(value) for value in solution)) if solution[0] > 0 else None


def _candidates(
    x: FloatArray, y: FloatArray, random: np.random.Generator, *, shift: bool
) -> tuple[FloatArray, FloatArray]:
    """Factors and shifts through one random pixel each, or through two."""
    first, second = random.integers(0, len(x), (2, _DRAWS))
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = (y[first] - y[second]) / (x[first] - x[second]) if shift else y[first] / x[first]
        shifts = y[first] - factors * x[first] if shift else np.zeros(_DRAWS)
    usable = np.isfinite(factors) & (factors > 0)
    return factors[usable], shifts[usable]
