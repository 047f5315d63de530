"""A lens from start to end: views of a board collected, the camera fitted to them, the result as a file and as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from scipy.optimize import least_squares

from flockd.core.choices import LENS_MODELS, LensModel
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, MeasurementConfig
from flockd.core.data import written_whole
from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, PinholeCamera, RigidTransform, WideAngleCamera, rotation_from_vector
from flockd.ground.calibration.board import (
    MAX_DROPPED,
    CalibrationError,
    first_pose,
    inliers,
    residuals_px,
    root_mean_square,
)
from flockd.ground.calibration.fragment import rig_text
from flockd.ground.calibration.image_sources import ImageStream
from flockd.ground.calibration.views import Collector, View

MIN_VIEWS = 6
_COEFFICIENTS = {"pinhole": 5, "wide_angle": 4}
_FIRST_FOCALS = {
    "pinhole": np.geomspace(0.3, 4.0, 9),
    "wide_angle": 1.0 / np.radians(np.linspace(60.0, 240.0, 9)),
}
"""Focal lengths at which the fit starts, in widths of the image."""
_MARGIN_PX, _ROUNDS = 0.1, 5
"""Iterations of the rejection of outliers."""
_STEP = 1.5e-8
"""Step of numeric derivatives: the root of double precision."""
_MAX_STEPS, _GAIN = 60, 1e-10
"""A fit ends after this many steps, or when a step changes the squares, or the parameters, by a smaller share."""
_UNKNOWN = 1e-13
"""Least eigenvalue of a scaled normal matrix: a smaller one is rounding."""
_FOCAL_SIGMA = 0.01
"""Largest relative standard deviation of a focal length that counts as known."""
_CENTRE_SIGMA = 0.01
"""The same for the principal point, in widths of the image."""
_LEAST_TILT_DEG = 10.0
CLEARLY_BETTER = 0.8
"""A more complicated model is chosen if its residual is below this share of a simpler one's."""


@dataclass(frozen=True, eq=False)
class Lens:
    """A calibrated camera, with the residuals of its views."""

    model: LensModel
    camera: Camera
    sigma: FloatArray
    """Standard deviations of fx, fy, cx, cy and the distortion, from the residuals: the effect of noise alone."""
    views: tuple[View, ...]
    """Views that it was fitted to."""
    poses: tuple[RigidTransform, ...]
    """``T_camera_board`` of each."""
    dropped: tuple[tuple[View, float], ...]
    """Views that contradict the others, each with its residual in pixels."""

    def residuals(self) -> list[FloatArray]:
        """For each view (n, 2) pixels, measured minus predicted."""
        return [residuals_px(self.camera, view.seen, pose) for view, pose in zip(self.views, self.poses, strict=True)]

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance of all corners."""
        return root_mean_square(np.concatenate(self.residuals()))

    @property
    def tilts_deg(self) -> tuple[float, ...]:
        """Angle between the board's plane and the image's in each view, degrees."""
        return tuple(tilt_deg(pose) for pose in self.poses)

    @property
    def reaches_corners(self) -> bool:
        """Whether the fitted lens gives a ray for every pixel of the image."""
        width, height = self.camera.size
        edges = np.array([(u, v) for u in (0.0, width / 2, width) for v in (0.0, height / 2, height)])
        return bool(np.isfinite(self.camera.rays(edges)).all())

    @property
    def field_of_view_deg(self) -> tuple[float, float]:
        """From left to right and from top to bottom through the principal point; NaN where it does not reach."""
        (width, height), cx, cy = self.camera.size, self.camera.matrix[0, 2], self.camera.matrix[1, 2]
        rays = self.camera.rays(np.array([(0.0, cy), (width, cy), (cx, 0.0), (cx, height)]))
        angles = np.degrees(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
        return float(angles[0] + angles[1]), float(angles[2] + angles[3])


def calibrate(views: Sequence[View], size: tuple[int, int], model: LensModel) -> Lens:
    """Fits a camera of this model by least squares.

    Raises CalibrationError for too few views, and for views that do not determine the camera: without tilt, or not of
    one flat board.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationError(
            f"{len(views)} usable views of the board are too few; show it at least {MIN_VIEWS} times"
        )
    camera, poses = _begin(views, size, model)
    dropped: list[tuple[View, float]] = []
    kept = list(views)
    for _ in range(_ROUNDS):
        camera, poses, sigma = _fitted(camera, kept, poses)
        rms = np.array(
            [root_mean_square(residuals_px(camera, view.seen, pose)) for view, pose in zip(kept, poses, strict=True)]
        )
        fits = inliers(rms, _MARGIN_PX)
        if fits.all():
            break
        dropped += [(kept[index], float(rms[index])) for index in np.flatnonzero(~fits)]
        kept, poses = list(compress(kept, fits)), list(compress(poses, fits))
        if len(dropped) > MAX_DROPPED * len(views) or len(kept) < MIN_VIEWS:
            raise CalibrationError(
                f"{len(dropped)} of {len(views)} views contradict the others; use a flat, rigid board, focus that "
                "stays as it is, and the board's own numbers of squares"
            )
    lens = Lens(model, camera, sigma, tuple(kept), tuple(poses), tuple(dropped))
    _check_known(lens)
    return lens


def simplest_that_fits(lenses: Sequence[Lens]) -> Lens:
    """The simplest lens to which no other is clearly superior. ``lenses`` begin with the simplest, all fitted to the
    same views.

    Noise alone leaves one model a little less residual than another, and an absurd distortion can imitate a plain lens.
    """
    best_px = min(lens.rms_px for lens in lenses)
    return next(lens for lens in lenses if lens.rms_px * CLEARLY_BETTER <= best_px)


def tilt_deg(pose: RigidTransform) -> float:
    """Angle between the board's plane and the image's, degrees, 0 to 90."""
    return math.degrees(math.acos(min(abs(float(pose.rotation[2, 2])), 1.0)))


def _rough_tilts_deg(views: Sequence[View], size: tuple[int, int]) -> list[float]:
    """Tilts of the board before its camera is calibrated: good enough for advice."""
    return [0.0] * len(views) if len(views) < 2 else [tilt_deg(pose) for pose in _begin(views, size, "wide_angle")[1]]


def _check_known(lens: Lens) -> None:
    fx, fy = lens.camera.matrix[0, 0], lens.camera.matrix[1, 1]
    focal = float(max(lens.sigma[0] / fx, lens.sigma[1] / fy))
    centre = float(max(lens.sigma[2:4])) / lens.camera.size[0]
    tilted = max(lens.tilts_deg)
    known = focal < _FOCAL_SIGMA and centre < _CENTRE_SIGMA
    if tilted < _LEAST_TILT_DEG:
        raise CalibrationError(
            f"the board was tilted by {tilted:.0f} degrees at most, so that the focal length cannot be separated from "
            "the distance; show it tilted by 30 to 45 degrees to each side, up and down, and all over the image"
        )
    if not known:
        raise CalibrationError(
            f"the views leave the focal length uncertain by {100 * focal:.2g} % and the principal point by "
            f"{100 * centre:.2g} % of the width, with a residual of {lens.rms_px:.2f} px; show the board tilted, and "
            "all over the image, or choose another model"
        )


def _begin(views: Sequence[View], size: tuple[int, int], model: LensModel) -> tuple[Camera, list[RigidTransform]]:
    """The best of a few plain lenses, with the board's pose in each view."""
    best: tuple[float, float, list[tuple[float, RigidTransform | None]]] | None = None
    for focal in _FIRST_FOCALS[model]:
        camera = _camera(model, size, _first_numbers(focal, size))
        poses = [first_pose(camera, view.seen) for view in views]
        error = float(np.median([error for error, _ in poses]))
        if best is None or error < best[0]:
            best = error, focal, poses
    assert best is not None
    lost = [view.name for view, (_, pose) in zip(views, best[2], strict=True) if pose is None]
    if lost:
        raise CalibrationError(f"{lost[0]}: does not show a flat board; remove it, or check the board's squares")
    numbers = [*_first_numbers(best[1], size), *np.zeros(_COEFFICIENTS[model])]
    return _camera(model, size, numbers), [pose for _, pose in best[2] if pose is not None]


def _fitted(
    camera: Camera, views: Sequence[View], poses: Sequence[RigidTransform]
) -> tuple[Camera, list[RigidTransform], FloatArray]:
    """Camera and poses with the least squared residual, from a start; and the deviations of the camera's numbers.

    OpenCV's `fisheye.calibrate` does not begin with a board that a wide lens sees beside itself, nor gives deviations.
    """
    model: LensModel = "pinhole" if isinstance(camera, PinholeCamera) else "wide_angle"
    of = np.repeat(np.arange(len(views)), [2 * len(view.seen.ids) for view in views])
    pixels = np.concatenate([view.seen.pixels for view in views])
    lens = np.array([*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion])
    first = len(lens)

    def moved(x: FloatArray) -> list[RigidTransform]:
        """Each pose turned about the board's origin by three numbers, radians; three more are where that comes to."""
        steps = x[first:].reshape(-1, 6)
        turns = rotation_from_vector(steps[:, :3])
        return [RigidTransform(R @ pose.rotation, step[3:]) for R, pose, step in zip(turns, poses, steps, strict=True)]

    def residuals(x: FloatArray) -> FloatArray:
        if min(x[:2]) <= 0.0:  # no possible camera: the step is refused
            return np.full(pixels.size, np.nan)
        points = [pose.apply(view.seen.points) for view, pose in zip(views, moved(x), strict=True)]
        off: FloatArray = _camera(model, camera.size, x[:first]).project(np.concatenate(points)) - pixels
        return off.ravel()

    def derivative(x: FloatArray) -> FloatArray:
        """(m, n): the same number of all poses is moved at once, as no residual hangs on two of them."""
        here, rows = residuals(x), np.arange(pixels.size)
        found = np.zeros((len(here), len(x)))
        for number in range(first + 6):
            own = number + (6 * of if number >= first else 0 * of)
            there = x.copy()
            there[number : None if number >= first else number + 1 : 6] += _STEP * max(1.0, abs(x[number]))
            found[rows, own] = (residuals(there) - here) / (there - x)[own]
        return np.nan_to_num(found)

    start = np.concatenate([lens, *([0.0, 0.0, 0.0, *pose.translation] for pose in poses)])
    if not np.isfinite(residuals(start)).all():
        raise CalibrationError("the views contradict each other; check the board's squares")
    found = least_squares(residuals, start, derivative, x_scale="jac", xtol=_GAIN, ftol=_GAIN, max_nfev=_MAX_STEPS)
    hessian = found.jac.T @ found.jac
    scale = np.sqrt(np.diag(hessian))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    variance = 2.0 * found.cost / max(len(found.fun) - len(start), 1)
    sigma = np.sqrt(variance * (vectors**2 @ (1.0 / np.maximum(values, _UNKNOWN)))) / scale
    return _camera(model, camera.size, found.x[:first]), moved(found.x), sigma[:first]


def _first_numbers(focal: float, size: tuple[int, int]) -> list[float]:
    """``focal``: in widths of the image."""
    return [focal * size[0], focal * size[0], size[0] / 2, size[1] / 2]


def _camera(model: LensModel, size: tuple[int, int], numbers: Iterable[float]) -> Camera:
    fx, fy, cx, cy, *distortion = (float(number) for number in numbers)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    kind = PinholeCamera if model == "pinhole" else WideAngleCamera
    return kind(matrix, size, tuple(distortion))


ENOUGH_VIEWS, ENOUGH_SHARE = 20, 0.9
"""Number of views from a live camera, and share of the image that they cover, at which it ends."""


def collect_views(
    images: ImageStream,
    collector: Collector,
    on_image: Callable[[int, int], None],
    on_advice: Callable[[str], None],
) -> None:
    """Gives the collector every image.

    ``on_image`` is called with the number of images done and their total; ``on_advice``, only for a live camera, with
    the next instruction for the person who holds the board, each time it changes.
    """
    advised = ""
    for number, (name, image) in enumerate(images.images, start=1):
        collector.offer(name, image, moving=images.live)
        on_image(number, images.count or number)
        if images.live and (advice := _next_step(collector)) != advised:
            on_advice(advice)
            advised = advice


def is_enough(collector: Collector) -> bool:
    """Whether a live camera's views are enough, cover the image and are tilted enough."""
    seen = collector.coverage
    if seen is None or len(collector.views) < ENOUGH_VIEWS:
        return False
    return seen.share >= ENOUGH_SHARE and not seen.advice(_rough_tilts_deg(collector.views, seen.size))


def fit_lenses(collector: Collector, model: LensModel | None, source: str) -> list[Lens]:
    """A lens of the given model, or one of each model that fits.

    Raises CalibrationError, which names ``source``, without views or if no model fits.
    """
    counts = collector.counts()
    if collector.coverage is None:
        raise CalibrationError(f"{source}: holds no image of the camera; name another source")
    if not collector.views:
        why = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        raise CalibrationError(
            f"{source}: the board is in none of the {sum(counts.values())} images ({why}), and the last shows "
            f"{collector.found_instead()}; check --squares, and that it fills a good part of the image"
        )
    found, faults = [], []
    for one in (model,) if model else LENS_MODELS:
        try:
            found.append(calibrate(collector.views, collector.coverage.size, one))
        except CalibrationError as error:
            faults.append(error)
    if not found:
        raise CalibrationError(f"{source}: {faults[0]}")
    return found


def write_lens(camera: str, lens: Lens, measured: MeasurementConfig, out: Path) -> IntrinsicsConfig:
    """Writes a drone with this one camera as YAML, and gives the lens as configuration: to ten thousandths of a pixel,
    and the distortion as exactly."""
    fx, fy, cx, cy = (round(float(value), 4) for value in lens.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]])
    distortion = tuple(round(k, 8) for k in lens.camera.distortion)
    intrinsics = IntrinsicsConfig(
        model=lens.model, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion, measured=measured
    )
    comment = (
        f"The lens of camera {camera}, written by `flockd calibrate camera`. Copy `intrinsics` to the camera of this",
        "name in your drone's file, then run `flockd config check` on that; this file too is a drone with one camera.",
    )
    try:
        config = CameraConfig(name=camera, size_px=lens.camera.size, intrinsics=intrinsics)
    except ValidationError as error:
        fault = error.errors()[0]
        told = f"the fitted lens is impossible: {fault['loc'][-1]}: {fault['msg'].rpartition(';')[0]}"
        raise CalibrationError(f"{told}; show the board in all corners of the image, from near and tilted") from None
    with written_whole(out) as draft:
        draft.write_text(rig_text((config,), comment), encoding="utf-8")
    return intrinsics


def lens_result(lens: Lens, lenses: Sequence[Lens], collector: Collector) -> dict[str, Any]:
    """Numbers for machines: pixels, degrees, residuals by view, and advice. ``lenses``: one of each fitted model."""
    assert collector.coverage is not None
    advice = list(collector.coverage.advice(lens.tilts_deg))
    if not lens.reaches_corners:
        advice.append("show the board in the corners of the image: the fitted lens does not reach them")
    residuals = lens.residuals()
    of_views = {view.name: root_mean_square(own) for view, own in zip(lens.views, residuals, strict=True)}
    max_px = float(np.linalg.norm(np.concatenate(residuals), axis=1).max())
    return {
        "size_px": list(lens.camera.size),
        "sigma_px": {key: float(value) for key, value in zip(("fx", "fy", "cx", "cy"), lens.sigma, strict=False)},
        "field_of_view_deg": [angle if math.isfinite(angle) else None for angle in lens.field_of_view_deg],
        "residual_px": {"rms": lens.rms_px, "max": max_px, "views": of_views},
        "models": {one.model: {"rms_px": one.rms_px} for one in lenses},
        "coverage": collector.coverage.share,
        "views": len(lens.views),
        "refused": collector.counts(),
        "blurred": {one.name: one.edge_px for one in collector.refused if one.why == "blurred"},
        "dropped": {view.name: value for view, value in lens.dropped},
        "advice": advice,
    }


def _next_step(collector: Collector) -> str:
    """Instruction for a person who holds a board in front of a live camera."""
    assert collector.coverage is not None
    head = f"{len(collector.views)} views, {100 * collector.coverage.share:.0f} % covered"
    if not collector.views:
        return f"{head}: hold the board before the camera, and hold it still"
    advice = collector.coverage.advice(_rough_tilts_deg(collector.views, collector.coverage.size))
    return f"{head}: {advice[0] if advice else 'go on, or end it with Ctrl-C'}"
