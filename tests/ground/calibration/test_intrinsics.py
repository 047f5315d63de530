"""A lens is found again from photographs of a board, and what cannot be known is refused."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.choices import LENS_MODELS
from flockd.ground.calibration.board import BoardFinder, CalibrationError
from flockd.ground.calibration.lens_fit import Lens as Fitted
from flockd.ground.calibration.lens_fit import calibrate, simplest_that_fits
from flockd.ground.calibration.views import Collector, Coverage
from tests.ground.calibration import darkroom
from tests.ground.calibration.darkroom import PINHOLE, SPEC, WIDE, Lens, facing, photograph

VIEWS = 16


@cache
def collected(lens: Lens) -> Collector:
    collector = Collector(BoardFinder(SPEC))
    for number, place in enumerate(darkroom.sight(lens, VIEWS)):
        collector.offer(f"{number}", photograph(lens, place, seed=number))
    return collector


@pytest.mark.parametrize("lens", [PINHOLE, WIDE], ids=lambda lens: lens.model)
def test_a_lens_is_found_again(lens: Lens) -> None:
    found = calibrate(collected(lens).views, lens.size, lens.model)
    matrix = found.camera.matrix
    focal, centre = np.array([matrix[0, 0], matrix[1, 1]]), matrix[:2, 2]
    assert focal == pytest.approx([lens.fx, lens.fy], rel=0.003)
    assert centre == pytest.approx([lens.cx, lens.cy], abs=1.0)
    assert found.rms_px < 0.12
    # Where every pixel looks: the lens as a whole, whatever its coefficients trade among themselves. A principal point
    # that is a little off is the same as a camera that is mounted a little turned.
    width, height = lens.size
    u, v = np.meshgrid(np.arange(40, width - 40, 20) + 0.5, np.arange(40, height - 40, 20) + 0.5)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    true = darkroom.rays(lens)[v.astype(int), u.astype(int)].reshape(-1, 3).astype(np.float64)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    mount, _ = Rotation.align_vectors(true, found.camera.rays(pixels))
    off_px = np.linalg.norm(true - mount.apply(found.camera.rays(pixels)), axis=1) * lens.fx
    assert mount.magnitude() < np.radians(0.2)
    assert np.median(off_px) < 0.1
    assert off_px.max() < 0.5
    # The truth lies where the deviations say.
    assert np.all(np.abs(focal - [lens.fx, lens.fy]) < 4 * found.sigma[:2])
    assert np.all(np.abs(centre - [lens.cx, lens.cy]) < 4 * found.sigma[2:4])


def test_a_plain_pinhole_is_not_taken_for_a_wide_angle_with_absurd_distortion() -> None:
    """Both models fit a lens without distortion, and noise decides which leaves less residual."""
    plain = Lens("pinhole", (480, 360), 402.3, 405.1, 246.7, 175.2, (0.0, 0.0, 0.0, 0.0, 0.0))
    views = collected(plain).views
    pinhole, wide = (calibrate(views, plain.size, model) for model in LENS_MODELS)
    assert wide.rms_px == pytest.approx(pinhole.rms_px, rel=0.05), "the residual does not tell"
    assert simplest_that_fits([pinhole, wide]) is pinhole


@pytest.mark.parametrize(("wide_px", "chosen"), [(0.11, "pinhole"), (0.09, "pinhole"), (0.05, "wide_angle")])
def test_a_more_complicated_lens_has_to_fit_clearly_better(wide_px: float, chosen: str) -> None:
    fitted = {"pinhole": SimpleNamespace(rms_px=0.10), "wide_angle": SimpleNamespace(rms_px=wide_px)}
    assert simplest_that_fits(cast("list[Fitted]", list(fitted.values()))) is cast("Fitted", fitted[chosen])


def test_a_wide_lens_does_not_pass_for_a_pinhole() -> None:
    with pytest.raises(CalibrationError, match=r"with a residual of 1\.\d+ px; show the board .* another model$"):
        calibrate(collected(WIDE).views, WIDE.size, "pinhole")
    with pytest.raises(CalibrationError, match=r"^5 usable views of the board are too few; show it at least 6 times$"):
        calibrate(collected(PINHOLE).views[:5], PINHOLE.size, "pinhole")


@pytest.mark.parametrize("lens", [PINHOLE, WIDE], ids=lambda lens: lens.model)
def test_boards_that_are_all_parallel_to_the_image_give_no_focal_length(lens: Lens) -> None:
    collector = Collector(BoardFinder(SPEC))
    for number, place in enumerate(darkroom.sight(lens, 8, seed=3, tilt_deg=0.0)):
        collector.offer(f"{number}", photograph(lens, place, seed=number))
    assert len(collector.views) >= 6
    with pytest.raises(CalibrationError, match=r"tilted by 30 to 45 degrees"):
        calibrate(collector.views, lens.size, lens.model)


def test_a_view_that_does_not_fit_is_dropped_and_named() -> None:
    collector = Collector(BoardFinder(SPEC))
    for number, place in enumerate(darkroom.sight(PINHOLE, VIEWS)):
        image = photograph(PINHOLE, place, seed=number)
        if number == 5:  # as if somebody had touched the zoom
            width, height = PINHOLE.size
            image = cv2.resize(image, None, fx=1.05, fy=1.0)[:height, :width]  # type: ignore[assignment]
        collector.offer(f"{number}", image)
    found = calibrate(collector.views, PINHOLE.size, "pinhole")
    assert [view.name for view, _ in found.dropped] == ["5"]
    assert found.camera.matrix[0, 0] == pytest.approx(PINHOLE.fx, rel=0.003)


def test_views_are_refused_with_the_reason() -> None:
    near = facing((0.0, 0.0, 0.28), 12.0, 40.0)
    collector = Collector(BoardFinder(SPEC))
    assert collector.offer("wall", photograph(PINHOLE, facing((0.0, 0.0, -1.0)))) == "no board"
    assert collector.offer("sharp", photograph(PINHOLE, near)) is None
    assert collector.offer("again", photograph(PINHOLE, near, seed=1)) == "like another"
    assert collector.offer("soft", photograph(PINHOLE, facing((0.03, 0.0, 0.28), 20.0), blur_px=2.0)) == "blurred"
    swung = cv2.blur(photograph(PINHOLE, facing((-0.03, 0.0, 0.28), 20.0)), (8, 1))
    assert collector.offer("swung", np.asarray(swung, np.uint8)) == "blurred"
    assert collector.counts() == {"no board": 1, "like another": 1, "blurred": 2}
    widths = {one.name: one.edge_px for one in collector.refused if one.edge_px is not None}
    # An edge out of focus by a deviation s rises from 10 to 90 % within 2.56 s; one swung over n pixels within n.
    assert widths["soft"] == pytest.approx(2.56 * 2.0, rel=0.25)
    assert widths["swung"] == pytest.approx(8.0, rel=0.25)
    with pytest.raises(CalibrationError, match=r"^b\.png: is 640 x 480 pixels and wall is 480 x 360; calibrate"):
        collector.offer("b.png", np.zeros((480, 640, 3), np.uint8))


def test_a_board_in_motion_is_no_view() -> None:
    collector = Collector(BoardFinder(SPEC))
    here, there = (photograph(PINHOLE, facing((x, 0.0, 0.4), 12.0)) for x in (0.0, 0.02))
    assert [collector.offer("", image, moving=True) for image in (here, there, there)] == ["moving", "moving", None]


def test_coverage_counts_the_lenss_own_image_and_says_where_to_go() -> None:
    coverage = Coverage((480, 360))
    light = np.full((360, 480), 120, np.uint8)
    light[:, :60] = 0  # the lens shows nothing in the first of eight columns
    coverage.add_light(light)
    coverage.add(np.array([[u, v] for u in range(70, 480, 20) for v in range(10, 230, 20)], np.float64))
    assert coverage.share == pytest.approx(4 / 6)
    assert coverage.text[0] == "   ## ## ## ## ## ## ##"
    assert coverage.text[5] == "   .. .. .. .. .. .. .."
    advice = coverage.advice([5.0, 20.0, 30.0, 8.0])
    assert advice[0].startswith("tilt the board by 30 to 45 degrees")
    assert "2 of 4 views" in advice[0]
    assert advice[1].startswith("hold the board at the bottom")
    assert coverage.advice([20.0, 20.0, 30.0, 18.0]) == advice[1:]
