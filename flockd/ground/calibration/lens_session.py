"""A lens from start to end: views of the board collected, the models fitted, the result as a file and as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from flockd.core.choices import LENS_MODELS, LensModel
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, MeasurementConfig
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.calibration.fragment import intrinsics_of, rig_text
from flockd.ground.calibration.image_sources import ImageStream
from flockd.ground.calibration.intrinsics import Lens, calibrate, rough_tilts_deg
from flockd.ground.calibration.views import Collector
from flockd.onboard.recording.editing import written_whole

ENOUGH_VIEWS, ENOUGH_SHARE = 20, 0.9
"""Views are taken from a live camera until there are this many, which cover this share of the image."""


def collect_views(
    images: ImageStream,
    camera: str,
    collector: Collector,
    on_image: Callable[[int, int], None],
    on_advice: Callable[[str], None],
) -> None:
    """Gives the collector every image of one camera.

    ``on_image`` is called with the number of images done and the number there are; ``on_advice``, with a live camera
    only, with what the person who holds the board should do next, each time that changes.
    """
    advised = ""
    for number, one in enumerate(images.sets, start=1):
        if camera in one.images:
            collector.offer(one.name, one.images[camera], moving=images.live)
        on_image(number, images.count or number)
        if images.live and (advice := _next_step(collector)) != advised:
            on_advice(advice)
            advised = advice


def is_enough(collector: Collector) -> bool:
    """Whether a live camera has given enough views, which cover the image and are tilted enough."""
    if len(collector.views) < ENOUGH_VIEWS or collector.coverage is None or collector.size is None:
        return False
    tilts = rough_tilts_deg(collector.views, collector.size, "wide_angle")
    return collector.coverage.share >= ENOUGH_SHARE and not collector.coverage.advice(tilts)


def fit_lenses(collector: Collector, model: LensModel | None, source: str) -> list[Lens]:
    """A lens of the model that was asked for, or one of each model that fits.

    Raises CalibrationError, which names ``source``, where there is nothing to fit or no model fits.
    """
    counts = collector.counts()
    if collector.size is None:
        raise CalibrationError(f"{source}: holds no image of the camera; name another source")
    if not collector.views:
        why = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        raise CalibrationError(
            f"{source}: the board is in none of the {sum(counts.values())} images ({why}); check "
            "--squares and --dictionary, and that it fills a good part of the image"
        )
    found, faults = [], []
    for one in (model,) if model else LENS_MODELS:
        try:
            found.append(calibrate(collector.views, collector.size, one))
        except CalibrationError as error:
            faults.append(error)
    if not found:
        raise CalibrationError(f"{source}: {faults[0]}")
    return found


def write_lens(camera: str, lens: Lens, measured: MeasurementConfig, out: Path) -> IntrinsicsConfig:
    """Writes a drone with this one camera as YAML, and gives the lens as configuration."""
    intrinsics = intrinsics_of(lens, measured)
    comment = (
        f"The lens of camera {camera}, written by `flockd calibrate camera`. Copy `intrinsics` to the camera of this",
        "name in your drone's file, then run `flockd config check` on that; this file too is a drone with one camera.",
    )
    config = CameraConfig(name=camera, size_px=lens.camera.size, intrinsics=intrinsics)
    with written_whole(out) as draft:
        draft.write_text(rig_text((config,), comment), encoding="utf-8")
    return intrinsics


def lens_result(lens: Lens, lenses: Sequence[Lens], collector: Collector) -> dict[str, Any]:
    """Numbers for machines: pixels, degrees, residuals by view, and advice. ``lenses``: one of each fitted model."""
    assert collector.coverage is not None
    advice = list(collector.coverage.advice(lens.tilts_deg))
    if not lens.reaches_corners:
        advice.append("show the board in the corners of the image: the fitted lens does not reach them")
    of_views = dict(zip((view.name for view in lens.views), lens.rms_of_views_px, strict=True))
    return {
        "size_px": list(lens.camera.size),
        "sigma_px": {key: float(value) for key, value in zip(("fx", "fy", "cx", "cy"), lens.sigma, strict=False)},
        "field_of_view_deg": [angle if math.isfinite(angle) else None for angle in lens.field_of_view_deg],
        "residual_px": {"rms": lens.rms_px, "max": lens.max_px, "views": of_views},
        "models": {one.model: {"rms_px": one.rms_px} for one in lenses},
        "coverage": collector.coverage.share,
        "views": len(lens.views),
        "refused": collector.counts(),
        "blurred": {one.name: one.edge_px for one in collector.refused if one.why == "blurred"},
        "dropped": {view.name: value for view, value in lens.dropped},
        "advice": advice,
    }


def _next_step(collector: Collector) -> str:
    """For a person who holds a board before a live camera."""
    assert collector.coverage is not None
    assert collector.size is not None
    head = f"{len(collector.views)} views, {100 * collector.coverage.share:.0f} % covered"
    if not collector.views:
        return f"{head}: hold the board before the camera, and hold it still"
    advice = collector.coverage.advice(rough_tilts_deg(collector.views, collector.size, "wide_angle"))
    return f"{head}: {advice[0] if advice else 'go on, or end it with Ctrl-C'}"
