"""Depth from a video of a drawn scene whose depth geometry tells. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tools.training.moving_cameras import Clip, MovingCameras, clip_of, ground_of

WIDTH, HEIGHT, FOCAL = 320, 240, 0.75
FOCAL_PX = FOCAL * WIDTH
WALL_M, BOARD_M = 8.0, 3.0
K = np.array([[FOCAL_PX, 0.0, WIDTH / 2], [0.0, FOCAL_PX, HEIGHT / 2], [0.0, 0.0, 1.0]])


def drawn(place: NDArray[np.float64], turn: float) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A board before a wall, both bumpy with noise, from a camera at ``place``, turned to the right; with its depth."""
    rng = np.random.default_rng(3)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    image, depth = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.zeros((HEIGHT, WIDTH))
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(column - WIDTH / 2) / FOCAL_PX, (row - HEIGHT / 2) / FOCAL_PX, np.ones_like(row)], axis=-1) @ R
    for z, half_m in ((WALL_M, 20.0), (BOARD_M, 0.7)):
        side = 1200
        texture = cv2.GaussianBlur(rng.uniform(0, 255, (side, side, 3)).astype(np.float32), (0, 0), 2.5)
        texture = np.clip((texture - 127) * 6 + 127, 0, 255).astype(np.uint8)
        away = (z - place[2]) / rays[..., 2]
        x, y = (place[i] + away * rays[..., i] for i in (0, 1))
        u, v = ((one / half_m + 1) / 2 * side for one in (x, y))
        seen = cv2.remap(texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        here = (np.abs(x) < half_m) & (np.abs(y) < half_m)
        image[here], depth[here] = seen[here], away[here]
    return image, depth


@pytest.fixture(scope="module")
def scene() -> tuple[list[NDArray[np.uint8]], list[NDArray[np.float64]]]:
    views = [drawn(np.array([0.3 * k - 0.75, 0.05 * k, 0.1 * k]), 0.01 * k) for k in range(6)]
    return [image for image, _ in views], [depth for _, depth in views]


def test_depth_is_what_geometry_says_up_to_one_scale(
    scene: tuple[list[NDArray[np.uint8]], list[NDArray[np.float64]]],
) -> None:
    pictures, truth = scene
    clip = clip_of(pictures, FOCAL)
    assert len(clip.images) >= 4
    first = next(k for k, picture in enumerate(pictures) if np.array_equal(picture, clip.images[0]))
    depth = clip.depth[0].astype(float)
    known = np.isfinite(depth)
    ratio = np.log(depth[known] / truth[first][known])
    assert known.mean() > 0.3
    assert np.abs(ratio - np.median(ratio)).mean() < 0.05
    board = known & (truth[first] < 5.0)
    assert board.any()
    assert (known & ~board).any()


def test_the_focal_length_is_found(scene: tuple[list[NDArray[np.uint8]], list[NDArray[np.float64]]]) -> None:
    assert clip_of(scene[0], None).focal_px == pytest.approx(FOCAL_PX, rel=0.2)


def test_a_camera_that_stands_still_shows_no_depth(
    scene: tuple[list[NDArray[np.uint8]], list[NDArray[np.float64]]],
) -> None:
    with pytest.raises(ValueError, match="stood still"):
        clip_of([scene[0][0]] * 4, FOCAL)


def test_a_window_keeps_its_rays_and_its_depth(tmp_path: Path) -> None:
    """Depth that grows along the rays to the right still does, in windows of any size, mirrored or not."""
    right = np.broadcast_to((np.arange(480) + 0.5 - 240) / 400.0, (320, 480))
    depth = (2.0 + right)[None].astype(np.float16)
    depth[0, :, 200:210] = np.nan
    Clip(np.full((1, 320, 480, 3), 90, np.uint8), depth, 400.0).save(tmp_path / "ramp.npz")
    clips, rng = MovingCameras(tmp_path), np.random.default_rng(0)
    clips.with_height = 0.0
    lost = []
    for _ in range(12):
        sample = clips.sample(rng, 256)
        known = np.isfinite(sample["depth"][0])
        lost.append(not known.all())
        off = sample["depth"][0] - 2.0
        both = np.abs(off - sample["geometry"][0])[known], np.abs(off + sample["geometry"][0])[known]
        assert min(one.max() for one in both) < 0.01
        assert sample["metric"] == 0
    assert any(lost)


def of_ground(*, post: bool) -> NDArray[np.float16]:
    """(1, 240, 320) depth of ground 1.5 below a camera that looks down by 30 degrees, with a wide post on it or not."""
    row, _ = np.mgrid[:240, :320]
    down = (row + 0.5 - 120) / 200.0
    depth = 1.5 / (np.cos(np.pi / 6) * down + 0.5)
    if post:
        depth[:150, 140:180] = 2.0
    depth[:40] = np.nan
    return np.asarray(depth[None], np.float16)


def test_ground_is_found_under_what_stands_on_it() -> None:
    ground = ground_of(of_ground(post=True)[0], 200.0)
    assert ground is not None
    np.testing.assert_allclose(ground, np.array([0.0, np.cos(np.pi / 6), 0.5]) / 1.5, atol=0.01)
    wall = np.full((240, 320), 3.0)
    assert ground_of(wall, 200.0) is None


def test_who_is_told_a_height_is_told_the_metres(tmp_path: Path) -> None:
    """On flat ground the depth is then the ground's that the planes say, of whatever metres; else there is no scale."""
    Clip(np.full((1, 240, 320, 3), 90, np.uint8), of_ground(post=False), 200.0).save(tmp_path / "ground.npz")
    clips, rng, told = MovingCameras(tmp_path), np.random.default_rng(1), []
    for _ in range(30):
        sample = clips.sample(rng, 128)
        inverse = sample["geometry"][2]
        known = np.isfinite(sample["depth"][0])
        told.append(float(sample["metric"]))
        assert (inverse > 0).any() == (sample["metric"] == 1)
        if told[-1]:
            np.testing.assert_allclose(sample["depth"][0][known] * inverse[known], 1.0, atol=0.15)
    assert 0.3 < np.mean(told) < 0.9
