"""Motion blur and rolling shutter against their physics, and against views drawn at every instant."""

from __future__ import annotations

import math
from functools import cache
from typing import Literal

import numpy as np
import pytest

from flockd.core.messages import Float32Array, FloatArray
from flockd.flight.geometry import Camera, PinholeCamera, WideAngleCamera, rotation_from_vector
from flockd.sim.cameras.imperfect_cameras import ShakeConfig, ShutterConfig
from flockd.sim.cameras.lens_views import lens_view
from flockd.sim.cameras.real_camera import linear_light
from flockd.sim.cameras.shutter import CameraMotion, LensField, Shake, Shaking, exposed
from flockd.sim.renderer.drone_models import drone_model
from flockd.sim.renderer.renderer import Renderer, View
from flockd.sim.world.world import World

SIZE = (320, 240)
PINHOLE = PinholeCamera(np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]]), SIZE)
FISHEYE = WideAngleCamera(np.array([[150.0, 0.0, 160.0], [0.0, 150.0, 120.0], [0.0, 0.0, 1.0]]), SIZE)


def still(times_s: FloatArray) -> FloatArray:
    return np.zeros((len(times_s), 3))


def motion(
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0), velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> CameraMotion:
    return CameraMotion(np.array(velocity), np.array(turn), still, {})


def view(depth_m: float, ids: np.ndarray | None = None) -> View:
    shape = SIZE[::-1]
    ids = np.zeros(shape, np.uint8) if ids is None else ids
    return View(np.zeros((*shape, 3), np.uint8), np.full(shape, depth_m, np.float32), ids)


def edge(column: float) -> Float32Array:
    """Black to the left of a column, white to the right."""
    light = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    light[:, math.ceil(column) :] = 1.0
    return light


def columns(light: Float32Array) -> FloatArray:
    """Where each row turns from black to white."""
    return np.asarray(SIZE[0] - light[..., 0].sum(axis=1, dtype=np.float64))


def width_px(row: FloatArray) -> float:
    """Over which an edge rises evenly: the variance of an even spread is its square over 12."""
    spread = np.diff(row)
    places = np.arange(len(spread))
    mean = (places * spread).sum() / spread.sum()
    return math.sqrt(12 * float((spread * (places - mean) ** 2).sum() / spread.sum()))


def taken(
    light: Float32Array, seen: View, how: CameraMotion, camera: Camera = PINHOLE, **shutter: object
) -> Float32Array:
    return exposed(light, seen, LensField.of(camera), how, ShutterConfig.model_validate(shutter))


def test_a_turn_smears_by_rate_times_exposure_times_focal_length() -> None:
    """1 rad/s, 30 ms, 300 px: 9 px."""
    blurred = taken(edge(160), view(np.inf), motion(turn=(0.0, 1.0, 0.0)), exposure_s=0.03)
    assert width_px(blurred[120, :, 0].astype(float)) == pytest.approx(9.0, rel=0.08)
    assert columns(blurred)[120] == pytest.approx(160, abs=0.1), "around where it was at the middle of the exposure"


def test_a_move_smears_by_what_is_near_and_not_by_what_is_far() -> None:
    """2 m/s to the right at 4 m, 40 ms, 300 px: 6 px."""
    how = motion(velocity=(2.0, 0.0, 0.0))
    near, far = (taken(edge(160), view(d), how, exposure_s=0.04)[120, :, 0].astype(float) for d in (4.0, np.inf))
    assert width_px(near) == pytest.approx(6.0, rel=0.12)
    assert np.array_equal(far, edge(160)[120, :, 0])


def test_a_rolling_shutter_skews_by_rate_times_readout_times_focal_length() -> None:
    """1 rad/s to the right, 30 ms from the first row to the last, 300 px: what is seen is 9 px farther left below."""
    skewed = columns(taken(edge(160), view(np.inf), motion(turn=(0.0, 1.0, 0.0)), readout_s=0.03))
    assert skewed[0] - skewed[-1] == pytest.approx(9.0 * 239 / 240, rel=0.03)
    assert skewed[120] == pytest.approx(160, abs=0.1), "the middle row is of the image's time"
    assert np.abs(np.diff(skewed, 2)).max() < 0.1, "evenly"


@pytest.mark.parametrize(("readout_from", "later_px"), [("left", -9.0), ("right", 9.0)])
def test_a_camera_on_its_side_is_read_across(readout_from: str, later_px: float) -> None:
    """1 rad/s downward, 30 ms from one side to the other, 300 px: 9 px farther up where it is read last."""
    light = edge(120).transpose(1, 0, 2)[: SIZE[1]].copy()
    light = np.repeat(light[:, :1], SIZE[0], axis=1)
    seen = taken(light, view(np.inf), motion(turn=(-1.0, 0.0, 0.0)), readout_s=0.03, readout_from=readout_from)
    rises = SIZE[1] - seen[..., 0].sum(axis=0, dtype=np.float64)
    assert rises[-1] - rises[0] == pytest.approx(later_px * 319 / 320, rel=0.03)
    assert rises[160] == pytest.approx(120, abs=0.1)


def test_shaking_skews_a_camera_on_its_side_as_one_upright_that_is_turned() -> None:
    """The square scene's light, turned by a quarter, read from the right: as that of the scene read from the top."""
    square = PinholeCamera(np.array([[200.0, 0.0, 120.0], [0.0, 200.0, 120.0], [0.0, 0.0, 1.0]]), (240, 240))
    light = np.random.default_rng(3).random((24, 24, 3), dtype=np.float32).repeat(10, axis=0).repeat(10, axis=1)
    shaking = Shaking(ShakeConfig(rms_deg=1.0, frequency_hz=50.0), np.random.default_rng(4))
    none = np.zeros((240, 240), np.uint8)
    seen = View(np.zeros((240, 240, 3), np.uint8), np.full((240, 240), np.inf, np.float32), none)

    def turned(times_s: FloatArray) -> FloatArray:
        right, down, ahead = shaking.at(times_s).T  # the upright image's right is the sensor's up
        return np.stack([-down, right, ahead], axis=1)

    def shown(image: Float32Array, shake: Shake, readout_from: Literal["top", "right"]) -> Float32Array:
        how = CameraMotion(np.zeros(3), np.zeros(3), shake, {})
        return exposed(image, seen, LensField.of(square), how, ShutterConfig(readout_s=0.03, readout_from=readout_from))

    upright = shown(light, shaking.at, "top")
    on_its_side = shown(np.ascontiguousarray(np.rot90(light, -1)), turned, "right")
    assert np.abs(upright - light).mean() > 0.01
    np.testing.assert_allclose(np.rot90(on_its_side), upright, atol=0.02)


def test_an_equidistant_lens_smears_the_same_50_degrees_off_its_axis() -> None:
    """Its radius grows by the focal length for each radian, anywhere: 1 rad/s, 40 ms, 150 px is 6 px."""
    for column in (160, 160 + round(150 * math.radians(50.0))):
        blurred = taken(edge(column), view(np.inf), motion(turn=(0.0, 1.0, 0.0)), FISHEYE, exposure_s=0.04)
        assert width_px(blurred[120, :, 0].astype(float)) == pytest.approx(6.0, rel=0.12)


def test_a_neighbour_is_shown_where_it_was_when_its_rows_were_read() -> None:
    """A square 3 m away, 3 m/s to the right, three quarters down, so read 10 ms after the middle row of 40 ms."""
    ids = np.zeros(SIZE[::-1], np.uint8)
    ids[175:185, 100:120] = 2
    light = np.repeat((ids > 0).astype(np.float32)[..., None], 3, axis=2)
    seen = view(3.0, ids)
    seen.depth[ids == 0] = np.inf
    how = CameraMotion(np.zeros(3), np.zeros(3), still, {2: np.array([3.0, 0.0, 0.0])})
    shown = taken(light, seen, how, readout_s=0.04)[..., 0]
    expected_px = 300.0 * 3.0 / 3.0 * (180.0 / 240 - 0.5) * 0.04
    moved = (shown * np.arange(SIZE[0])).sum() / shown.sum() - (light[..., 0] * np.arange(SIZE[0])).sum() / 200
    assert moved == pytest.approx(expected_px, abs=0.15)
    assert shown.sum() == pytest.approx(200, rel=0.02), "it is not cut, nor smeared"


def test_nothing_moves_and_no_bit_changes() -> None:
    light = np.random.default_rng(1).random((SIZE[1], SIZE[0], 3), dtype=np.float32)
    assert np.array_equal(taken(light, view(3.0), motion(), exposure_s=0.02, readout_s=0.03), light)
    assert np.array_equal(taken(light, view(3.0), motion(turn=(1.0, 1.0, 1.0))), light)


def test_shaking_blurs_as_its_angle_spreads_in_the_exposure() -> None:
    """The standard deviation of the angle about the axis that points down, in pixels of 300 to the radian."""
    shaking = Shaking(ShakeConfig(rms_deg=1.0, frequency_hz=50.0), np.random.default_rng(4))
    how = CameraMotion(np.zeros(3), np.zeros(3), shaking.at, {})
    row = taken(edge(160), view(np.inf), how, exposure_s=0.03)[120, :, 0].astype(float)
    angles = shaking.at(np.linspace(-0.015, 0.015, 500))[:, 1]
    assert width_px(row) / math.sqrt(12) == pytest.approx(float(angles.std()) * 300.0, rel=0.1)


@cache
def _drawn_scene() -> tuple[Renderer, FloatArray, FloatArray, FloatArray]:
    world = World.generate(11)
    place = world.free_points(1, np.random.default_rng(1), 3.0)[0]
    position = np.array([*place, -3.5 - float(world.height_at(place[:1], place[1:])[0])])
    drones = position + np.array([[4.0, 0.6, 0.8], [7.0, -2.5, -0.5]])
    return Renderer(world, [drone_model(0, 3), drone_model(5, 4)]), position, drones, np.stack([np.eye(3)] * 2)


@pytest.mark.parametrize(("camera", "exposure_s", "readout_s"), [(PINHOLE, 0.012, 0.02), (FISHEYE, 0.02, 0.03)])
def test_it_comes_near_to_views_drawn_at_every_instant(camera: Camera, exposure_s: float, readout_s: float) -> None:
    """A camera that flies 2 m/s ahead, 1 m/s aside, and turns at 40 degrees/s; neighbours fly at 2 m/s beside it.

    As the truth: views drawn at 24 instants, of which each row takes the mean of those in its exposure.
    """
    renderer, position, places, rotations = _drawn_scene()
    forward_right_down = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    velocity, turn = np.array([2.0, 1.0, 0.0]), np.array([0.3, 0.7, -0.2])
    velocities = np.array([[0.0, 2.0, 0.0], [1.0, -1.0, 0.5]])

    def at(time_s: float) -> View:
        R = forward_right_down @ rotation_from_vector(turn * time_s)
        return lens_view(
            camera,
            lambda matrix, size, part: renderer.render(
                matrix, size, R @ part, position + velocity * time_s,
                drone_rotations=rotations, drone_positions=places + velocities * time_s, shown=[0, 1],
            ),
        )  # fmt: skip

    span_s = exposure_s + readout_s
    instants = (np.arange(24) + 0.5) / 24 * span_s - span_s / 2
    lights = np.stack([linear_light(at(float(instant)).rgb) for instant in instants])
    middle_s = ((np.arange(SIZE[1]) + 0.5) / SIZE[1] - 0.5) * readout_s
    inside = np.abs(instants[:, None] - middle_s) <= exposure_s / 2
    truth = np.einsum("ih,ihwc->hwc", inside / inside.sum(axis=0), lights)
    now = at(0.0)
    sharp = linear_light(now.rgb)
    moves = {i + 1: velocities[i] @ forward_right_down for i in range(2)}
    how = CameraMotion(velocity @ forward_right_down, turn, still, moves)
    shown = taken(sharp, now, how, camera, exposure_s=exposure_s, readout_s=readout_s)
    margin = slice(12, -12)  # what comes in at the border was not drawn
    wrong, without = (np.abs(light - truth)[margin, margin] for light in (shown, sharp))
    drones = (now.ids > 0)[margin, margin]
    assert wrong.mean() < 0.4 * without.mean()
    assert wrong[drones].mean() < 0.7 * without[drones].mean()
