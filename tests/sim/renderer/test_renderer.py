"""The renderer against an independent ray caster, plane geometry and its own promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, PinholeCamera, WideAngleCamera
from flockd.sim.cameras.lens_views import lens_view
from flockd.sim.renderer.airframe import DroneModel
from flockd.sim.renderer.drone_models import FAMILIES, drone_model
from flockd.sim.renderer.renderer import Renderer, View, true_flow
from flockd.sim.world.world import GROUND, World

SIZE = (240, 320)
MATRIX = np.array([[150.0, 0.0, 118.0], [0.0, 148.0, 163.0], [0.0, 0.0, 1.0]])
R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
RANGES_M = (0.6, 1.5, 3.0, 6.0, 12.0)


class Scene:
    """A camera over a random world, with drones of different families at growing ranges in front of it."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.world = World.generate(seed)
        ground = self.world.free_points(1, rng, 3.0)[0]
        height = rng.uniform(2.0, 4.0) + self.world.height_at(ground[:1], ground[1:])[0]
        self.position = np.array([*ground, -height])
        self.R = _attitude(rng, 0.3) @ R_BODY_CAMERA
        self.drones = [drone_model(int(rng.integers(FAMILIES)), seed + k) for k in range(len(RANGES_M))]
        pixels = rng.uniform(0.25, 0.75, (len(RANGES_M), 2)) * SIZE
        rays = np.column_stack([pixels, np.ones(len(RANGES_M))]) @ np.linalg.inv(MATRIX).T
        self.positions = self.position + (rays * np.array(RANGES_M)[:, None]) @ self.R.T
        self.rotations = np.array([_attitude(rng, 0.4) for _ in RANGES_M])
        self.renderer = Renderer(self.world, self.drones)

    def render(self, **changes: FloatArray) -> View:
        pose = {"R": self.R, "position": self.position, "rotations": self.rotations, "positions": self.positions}
        return self.rendered(MATRIX, SIZE, **(pose | changes))

    def through(self, camera: Camera) -> View:
        """What a lens sees from there."""

        def draw(matrix: FloatArray, size: tuple[int, int], turn: FloatArray) -> View:
            return self.rendered(matrix, size, self.R @ turn, self.position, self.rotations, self.positions)

        return lens_view(camera, draw)

    def rays(self, u: NDArray[np.int64], v: NDArray[np.int64]) -> FloatArray:
        """(n, 3) NED through the middles of pixels, 1 m ahead."""
        middles = np.column_stack([u + 0.5, v + 0.5, np.ones(len(u))])
        return np.asarray(middles @ np.linalg.inv(MATRIX).T @ self.R.T)

    def cast(self, rays: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
        return _cast(self.world, self.drones, self.rotations, self.positions, self.position, rays)

    def rendered(
        self, matrix: FloatArray, size: tuple[int, int], R: FloatArray, position: FloatArray, rotations: FloatArray,
        positions: FloatArray,
    ) -> View:  # fmt: skip
        everyone = np.ones(len(self.drones), dtype=bool)
        return self.renderer.render(
            matrix, size, R, position, drone_rotations=rotations, drone_positions=positions, shown=everyone
        )


def _attitude(rng: np.random.Generator, tilt: float) -> FloatArray:
    angles = [rng.uniform(0, 2 * np.pi), rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt)]
    return np.asarray(Rotation.from_euler("ZYX", angles).as_matrix())


def _cast(
    world: World, drones: list[DroneModel], rotations: FloatArray, positions: FloatArray, origin: FloatArray,
    rays: FloatArray,
) -> tuple[FloatArray, NDArray[np.int64]]:  # fmt: skip
    """Distance in units of each ray's length (inf: nothing) and id of what it hits, by embree."""
    flying = [(one.vertices @ R.T + p, one.triangles) for one, R, p in zip(drones, rotations, positions, strict=True)]
    parts = [(world.vertices, world.triangles), *flying]
    ids = np.repeat(np.arange(len(parts)), [len(triangles) for _, triangles in parts])
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = np.vstack([triangles + begin for (_, triangles), begin in zip(parts, first, strict=False)])
    mesh = trimesh.Trimesh(np.vstack([vertices for vertices, _ in parts]) - origin, faces, process=False)
    caster = RayMeshIntersector(mesh)
    hits = caster.intersects_first(np.zeros_like(rays), rays)
    plane = mesh.triangles[hits]
    normal = np.cross(plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        along = (normal * plane[:, 0]).sum(1) / (normal * rays).sum(1)
    return np.where(hits >= 0, along, np.inf), np.where(hits >= 0, ids[hits], 0)


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [Scene(seed) for seed in (11, 12)]


def test_depth_and_ids_agree_with_a_ray_caster(scenes: list[Scene]) -> None:
    rng = np.random.default_rng(0)
    for scene in scenes:
        view = scene.render()
        index = rng.choice(view.ids.size, 20_000, replace=False)
        v, u = np.divmod(index, SIZE[0])
        depth, ids = scene.cast(scene.rays(u, v))
        seen = view.depth[v, u]
        with np.errstate(invalid="ignore"):
            same = (np.isinf(depth) & np.isinf(seen)) | (np.abs(seen - depth) <= 1e-3 * depth)
        # Rays that graze an edge may fall to either side.
        assert same.mean() > 0.999
        assert (ids == view.ids[v, u]).mean() > 0.999
        assert {1, 2, 3} <= set(np.unique(view.ids).tolist())


LENSES = {
    "fisheye of 120 degrees": WideAngleCamera(
        np.array([[152.8, 0.0, 160.0], [0.0, 152.8, 120.0], [0.0, 0.0, 1.0]]), (320, 240), (-0.02, 0.003, 0.0, 0.0)
    ),
    "fisheye of 210 degrees": WideAngleCamera(
        np.array([[87.0, 0.0, 160.0], [0.0, 87.0, 120.0], [0.0, 0.0, 1.0]]), (320, 240)
    ),
    "pinhole with distortion": PinholeCamera(
        np.array([[160.0, 0.0, 158.0], [0.0, 161.0, 121.0], [0.0, 0.0, 1.0]]), (320, 240), (-0.25, 0.08, 0.002, -0.001)
    ),
}


@pytest.mark.parametrize("lens", list(LENSES))
def test_what_any_lens_sees_agrees_with_a_ray_caster(scenes: list[Scene], lens: str) -> None:
    camera = LENSES[lens]
    for scene in scenes:
        view = scene.through(camera)
        v, u = np.divmod(np.arange(view.ids.size), camera.size[0])
        rays = camera.rays(np.column_stack([u, v]) + 0.5)
        imaged = np.isfinite(rays[:, 0])
        assert (view.rgb[v[~imaged], u[~imaged]] == 0).all()
        v, u, rays = v[imaged], u[imaged], rays[imaged]
        range_m, ids = scene.cast(rays @ scene.R.T)
        # The nearest ray that was drawn is up to half a pixel off: what is slanted or thin differs there.
        assert (ids == view.ids[v, u]).mean() > 0.996
        ahead = (rays[:, 2] > 0.05) & np.isfinite(range_m) & (range_m < 30.0) & (ids == view.ids[v, u])
        seen = view.depth[v, u][ahead] / rays[ahead, 2]
        assert (np.abs(seen / range_m[ahead] - 1.0) < 0.02).mean() > 0.98
        assert {1, 2, 3} <= set(np.unique(view.ids).tolist())


def test_a_drone_within_reach_has_no_holes(scenes: list[Scene]) -> None:
    """0.9 m wide and 0.3 m away: parts of it lie beside and behind the camera."""
    scene = scenes[0]
    drone, rotation = drone_model(7, 0), _attitude(np.random.default_rng(1), 0.1)
    position = scene.position + 0.3 * scene.R[:, 2]
    view = Renderer(scene.world, [drone]).render(
        MATRIX, SIZE, scene.R, scene.position, drone_rotations=rotation[None], drone_positions=position[None], shown=[0]
    )
    v, u = np.divmod(np.arange(view.ids.size), SIZE[0])
    depth, ids = _cast(scene.world, [drone], rotation[None], position[None], scene.position, scene.rays(u, v))
    depth, ids = depth.reshape(view.ids.shape), ids.reshape(view.ids.shape)
    assert (ids == 1).mean() > 0.2
    assert (ids == view.ids).mean() > 0.998
    near = (view.ids == 1) & (ids == 1)
    assert np.isclose(view.depth[near], depth[near], rtol=1e-3).mean() > 0.995


@pytest.fixture(scope="module")
def flat() -> World:
    return World.generate(3, ground_relief_m=0.0)


def test_flat_ground_has_the_depth_of_a_plane(flat: World) -> None:
    world = flat
    height, tilt = 5.0, 0.6
    R = Rotation.from_euler("ZYX", [1.0, -tilt, 0.1]).as_matrix() @ R_BODY_CAMERA
    origin = np.array([*world.free_points(1, np.random.default_rng(0), 3.0)[0], -height])
    view = Renderer(world, []).render(
        MATRIX, SIZE, R, origin, drone_rotations=np.empty((0, 3, 3)), drone_positions=np.empty((0, 3)), shown=[]
    )
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    down = (np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(MATRIX).T @ R.T)[..., 2]
    plane = np.where(down > 0, height / np.maximum(down, 1e-9), np.inf)
    on_ground = np.isclose(view.depth, plane, rtol=1e-5)
    # Everything else stands up from the ground, so it is nearer.
    assert on_ground[down > 0].mean() > 0.3
    assert (view.depth[~on_ground & (plane < 500.0)] < plane[~on_ground & (plane < 500.0)]).all()


def test_height_is_that_of_the_drawn_triangles(scenes: list[Scene]) -> None:
    world = scenes[1].world
    rng = np.random.default_rng(1)
    points = rng.uniform(-75, 75, (2000, 2))
    ground = world.triangles[world.texture == GROUND]
    caster = RayMeshIntersector(trimesh.Trimesh(world.vertices, ground, process=False))
    origins = np.column_stack([points, np.full(len(points), -50.0)])
    hits, rays, _ = caster.intersects_location(origins, np.tile([0.0, 0.0, 1.0], (len(points), 1)), multiple_hits=False)
    assert len(rays) == len(points)
    np.testing.assert_allclose(world.height_at(points[rays, 0], points[rays, 1]), -hits[:, 2], atol=1e-4)
    axis = np.linspace(-80, 80, 400)
    north, east = np.meshgrid(axis, axis)
    heights = world.height_at(north.ravel(), east.ravel())
    assert heights.std() == pytest.approx(0.15, rel=0.15)
    assert abs(heights.mean()) < 0.02


def test_nothing_taller_than_a_hand_stands_near_the_path() -> None:
    angle = np.linspace(0, 2 * np.pi, 100)
    path = np.column_stack([15 * np.sin(angle), 20 * np.cos(angle) - 10])
    world = World.generate(1, keep_out=path, clearance_m=9.0)
    objects = world.triangles[world.texture != GROUND]
    # Points all over every triangle, corners included.
    weights = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
    points = np.einsum("wk,tkc->twc", weights, world.vertices[objects]).reshape(-1, 3)
    tall = -points[:, 2] - world.height_at(points[:, 0], points[:, 1]) > 0.3
    assert tall.sum() > 0
    assert cKDTree(path).query(points[tall, :2])[0].min() >= 9.0


def test_free_points_are_free(scenes: list[Scene]) -> None:
    world = scenes[0].world
    points = world.free_points(50, np.random.default_rng(5), 2.0)
    objects = world.vertices[np.unique(world.triangles[world.texture != GROUND])]
    tall = objects[-objects[:, 2] - world.height_at(objects[:, 0], objects[:, 1]) > 0.4]
    assert min(np.hypot(tall[:, 0] - n, tall[:, 1] - e).min() for n, e in points) >= 1.9
    with pytest.raises(ValueError, match="away from every obstacle"):
        world.free_points(10, np.random.default_rng(5), 500.0)


def test_the_same_seed_gives_the_same_bytes(scenes: list[Scene], generate_anew: Callable[..., World]) -> None:
    first, second, other = scenes[0].world, generate_anew(11), scenes[1].world
    for field in fields(World):
        a, b = getattr(first, field.name), getattr(second, field.name)
        assert np.array_equal(a, b), field.name
    assert not np.array_equal(first.ground_map, other.ground_map)
    for family in range(FAMILIES):
        a, b, c = drone_model(family, 5), drone_model(family, 5), drone_model(family, 6)
        assert np.array_equal(a.vertices, b.vertices)
        assert np.array_equal(a.colours, b.colours)
        assert not np.array_equal(a.colours, c.colours)


@pytest.mark.parametrize("size", [(96, 96), (31, 17), (640, 480)])
def test_any_image_size_is_a_crop_of_the_same_image(scenes: list[Scene], size: tuple[int, int]) -> None:
    scene = scenes[0]
    whole = scene.render()
    shifted = MATRIX.copy()
    shifted[:2, 2] -= (100, 120)
    part = scene.rendered(shifted, size, scene.R, scene.position, scene.rotations, scene.positions)
    high, wide = min(size[1], SIZE[1] - 120), min(size[0], SIZE[0] - 100)
    a, b = part.rgb[:high, :wide].astype(int), whole.rgb[120 : 120 + high, 100 : 100 + wide].astype(int)
    assert part.rgb.shape == (size[1], size[0], 3)
    assert (np.abs(a - b).max(axis=-1) <= 1).mean() > 0.999


def test_flow_is_where_the_points_went(scenes: list[Scene]) -> None:
    """Points found by the ray caster, moved with what they sit on and projected, land where the flow says."""
    scene = scenes[1]
    rng = np.random.default_rng(4)
    turn = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix()
    R2, position2 = scene.R @ turn, scene.position + np.array([0.25, -0.15, 0.05])
    rotations2 = np.array([Rotation.from_rotvec([0, 0, 0.1]).as_matrix() @ R for R in scene.rotations])
    positions2 = scene.positions + rng.uniform(-0.2, 0.2, scene.positions.shape)
    first = scene.render()
    second = scene.render(R=R2, position=position2, rotations=rotations2, positions=positions2)
    flow, valid = true_flow(
        first, second, MATRIX, R_ned_camera=(scene.R, R2), position_ned=(scene.position, position2),
        drone_rotations=(scene.rotations, rotations2), drone_positions=(scene.positions, positions2),
    )  # fmt: skip
    assert valid[first.ids == 0].mean() > 0.7
    v, u = np.nonzero(valid & (rng.random(valid.shape) < 0.2))
    rays = scene.rays(u, v)
    depth, ids = scene.cast(rays)
    agree = (ids == first.ids[v, u]) & np.isclose(depth, first.depth[v, u], rtol=1e-3)
    points = scene.position + rays * np.where(np.isinf(depth), 1e9, depth)[:, None]
    for k in range(len(scene.drones)):
        mine = ids == k + 1
        body = (points[mine] - scene.positions[k]) @ scene.rotations[k]
        points[mine] = body @ rotations2[k].T + positions2[k]
    q = (points - position2) @ R2 @ MATRIX.T
    moved = q[:, :2] / q[:, 2:] - np.column_stack([u + 0.5, v + 0.5])
    assert agree.mean() > 0.99
    np.testing.assert_allclose(flow[v, u][agree], moved[agree], rtol=1e-3, atol=0.02)  # as far as the depths agree
    # And what is called visible is: a ray from the second camera to the moved point meets nothing on its way.
    back, _ = _cast(scene.world, scene.drones, rotations2, positions2, position2, points - position2)
    assert (back[agree & np.isfinite(depth)] > 0.97).mean() > 0.99
    assert {1, 2} <= set(first.ids[valid].tolist())


@pytest.mark.parametrize("family", range(FAMILIES))
def test_a_family_has_one_size_and_a_closed_mesh(family: int) -> None:
    models = [drone_model(family, seed) for seed in range(3)]
    for model in models:
        np.testing.assert_allclose(model.extent, models[0].extent, atol=1e-6)
        np.testing.assert_allclose(model.hubs, models[0].hubs, atol=1e-6)
        np.testing.assert_allclose(model.extent.mean(axis=0), 0.0, atol=1e-9)
        assert (model.vertices >= model.extent[0] - 1e-6).all()
        assert (model.vertices <= model.extent[1] + 1e-6).all()
        assert 150 <= len(model.triangles) <= 1400
        mesh = trimesh.Trimesh(model.vertices, model.triangles)
        mesh.merge_vertices(digits_vertex=5)
        # Every part's faces look outwards: each closed part has a positive volume.
        assert all(part.volume > 0 for part in mesh.split(only_watertight=True))
    assert 0.25 <= models[0].size_m <= 0.9


@pytest.mark.parametrize("family", range(FAMILIES))
def test_a_hub_is_where_a_motor_ends(family: int) -> None:
    """Straight down onto each hub, under the propeller: the motor's cap is what a ray meets, and four are all."""
    model = drone_model(family, 0)
    assert model.hubs.shape == (4, 3)
    caster = RayMeshIntersector(trimesh.Trimesh(model.vertices, model.triangles, process=False))
    above = model.hubs + np.array([0.001, 0.001, -0.002])
    hits, rays, _ = caster.intersects_location(above, np.tile([0.0, 0.0, 1.0], (4, 1)), multiple_hits=False)
    np.testing.assert_allclose(hits[np.argsort(rays), 2], model.hubs[:, 2], atol=1e-4)
    # Clockwise from the front right, or from the front.
    turns = np.degrees(np.arctan2(model.hubs[:, 1], model.hubs[:, 0]))
    assert 0 <= np.round(turns[0]) < 90
    assert (np.diff(np.unwrap(turns, period=360)) > 60).all()


def test_a_drone_shades_the_ground_away_from_the_sun(flat: World) -> None:
    world = flat
    drone = drone_model(7, 0)
    spot = world.free_points(1, np.random.default_rng(2), 12.0)[0]
    position = np.array([*spot, -3.0])
    sun = world.light[0]
    foot = position - sun * (position[2] / sun[2])
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # straight down, image top to the north
    above = np.array([*spot, -8.0])
    renderer = Renderer(world, [drone])
    views = [
        renderer.render(MATRIX, SIZE, R, above, drone_rotations=np.eye(3)[None], drone_positions=p[None], shown=[])
        for p in (position, np.full(3, np.nan))
    ]
    q = MATRIX @ R.T @ (foot - above)
    u, v = (q[:2] / q[2]).astype(int)
    darker = views[1].rgb.astype(int).sum(-1) - views[0].rgb.astype(int).sum(-1)
    assert (darker < -3).mean() < 1e-3  # edges are blended or not by what is seen beside them
    ys, xs = np.nonzero(darker > 0.5 * darker.max())
    assert darker.max() > 20
    assert np.hypot(xs.mean() - u, ys.mean() - v) < 3.0
