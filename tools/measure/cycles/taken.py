"""A moment as a drone's cameras took it, with the truth: rendered by Cycles, or drawn by flockd's renderer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import Frame, FrameSet, RangeReading, VehicleState
from flockd.flight.geometry import Rig, RigCamera, ZMap, range_map
from flockd.sim.airframe import DroneModel
from flockd.sim.autopilot.fake_range_finder import range_to_ground
from flockd.sim.drone_models import drone_model
from flockd.sim.lens_views import lens_view
from flockd.sim.renderer import Renderer, View
from flockd.sim.world import World
from tools.measure.cycles.jobs import airframe_file
from tools.measure.cycles.plan import STEP_S, Moment, blades, painted
from tools.training import worlds
from tools.training.own_mesh import joined, model_of

Array = NDArray[Any]
BAROMETER_SIGMA_M, RANGE_SIGMA_M = 0.1, 0.03
_NOISE = 1.5
"""Grey levels, as of the pictures by Cycles."""
_CLEARANCE_M = 1.5
_PLACES = 400


@dataclass(frozen=True, eq=False)
class Taken:
    """One drone's view before and after a step."""

    number: int
    rgb: Array
    """(2, cameras, h, w, 3)"""
    range_m: Array
    """(2, cameras, h, w) metres along the ray; 0 for the sky."""
    ids: Array
    """(2, cameras, h, w) 0 for the world, k for neighbour k - 1, with `PROPELLER` where its propellers turn."""
    names: tuple[str, ...]
    """Of the neighbours' shapes."""
    sizes_m: Array
    """(n,) propeller tip to tip."""
    R_ned_body: Array
    """(2, 3, 3)"""
    position: Array
    """(2, 3) NED."""
    neighbours: Array
    """(2, n, 3) NED."""
    vehicles: tuple[VehicleState, VehicleState]

    def frame_sets(self, rig: Rig) -> list[FrameSet]:
        """What the pilot is given."""
        return [
            FrameSet(
                k * STEP_S,
                {name: Frame(name, self.rgb[k, c], k * STEP_S, k) for c, name in enumerate(rig.cameras)},
            )
            for k in range(2)
        ]


def read_taken(path: Path, moment: Moment) -> Taken:
    """What `tools.measure.cycles.render` wrote of a moment and a rig."""
    with np.load(path) as arrays:
        values = dict(arrays)
    names = tuple(neighbour.airframe for neighbour in moment.neighbours)
    ups = [-pose.position[2] for pose in moment.own]
    vehicles = _vehicles(moment, ups, [float(value) for value in values["ground_range_m"]])
    return Taken(
        moment.number, values["rgb"], values["range_m"], values["ids"], names, values["sizes_m"],
        np.stack([pose.rotation for pose in moment.own]), np.array([pose.position for pose in moment.own]),
        _neighbours(moment), vehicles,
    )  # fmt: skip


def known_models(moment: Moment) -> tuple[list[DroneModel], list[str]]:
    """In the neighbours' places, shapes that the networks learnt from, and their names."""
    rng = np.random.Generator(np.random.PCG64([moment.seed, moment.number, 5]))
    families = [int(rng.choice(worlds.FAMILIES)) for _ in moment.neighbours]
    return [drone_model(family, int(rng.integers(1 << 30))) for family in families], [f"family {k}" for k in families]


def real_models(moment: Moment, folder: Path) -> list[DroneModel]:
    """The neighbours themselves, from the files of `tools.measure.cycles.render`; their propellers as blades."""
    models = []
    for neighbour in moment.neighbours:
        rng = np.random.Generator(np.random.PCG64(neighbour.seed))
        with np.load(airframe_file(folder, neighbour.airframe)) as arrays:
            shape = dict(arrays)
        parts = [(shape["vertices"], shape["triangles"], painted(shape["colours"], neighbour.paint))]
        for hub, radius_m in zip(shape["hubs"], shape["radii"], strict=True):
            corners = blades(hub, radius_m, rng.uniform(0.0, 2.0 * math.pi))
            parts.append((corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full((2, 3), 0.03)))
        models.append(model_of(*joined(parts), float(shape["size_m"])))
    return models


def draw_taken(moment: Moment, rig: Rig, models: Sequence[DroneModel], names: Sequence[str]) -> Taken:
    """The same places above a test world, drawn by flockd's renderer, with these shapes of these names there."""
    seed = worlds.TEST[moment.number + 5000]
    rng = np.random.Generator(np.random.PCG64([moment.seed, moment.number, 3]))
    world = World.generate(seed, ground_relief_m=float(rng.choice([0.0, 0.1, 0.2, 0.3])), keep_out=None)
    renderer = Renderer(world, models)
    planned, own = _neighbours(moment), np.array([pose.position for pose in moment.own])
    moved = _place(world, np.vstack([own, planned.reshape(-1, 3)]), rng)
    own, planned = own + moved, planned + moved
    R_ned_body = np.stack([pose.rotation for pose in moment.own])
    turned = np.array([[one.poses[k].rotation for one in moment.neighbours] for k in range(2)])
    rgb, ranges, ids = [], [], []
    for k in range(2):
        for mounted in rig.cameras.values():
            view = _view(renderer, mounted, R_ned_body[k], own[k], turned[k], planned[k])
            noisy = view.rgb + rng.normal(0.0, _NOISE, view.rgb.shape)
            rgb.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
            along = range_map(ZMap(view.depth), mounted.camera)
            ranges.append(np.where(np.isfinite(along), along, 0.0).astype(np.float32))
            ids.append(view.ids)
    shape = (2, len(rig.cameras), *ids[0].shape)
    below = [range_to_ground(own[k], R_ned_body[k, :, 2], world.height_at) for k in range(2)]
    return Taken(
        moment.number, np.stack(rgb).reshape(*shape, 3), np.stack(ranges).reshape(shape), np.stack(ids).reshape(shape),
        tuple(names), np.array([model.size_m for model in models]), R_ned_body, own,
        planned, _vehicles(moment, [-place[2] for place in own], below),
    )  # fmt: skip


def _view(
    renderer: Renderer, mounted: RigCamera, R_ned_body: Array, position: Array, turned: Array, places: Array
) -> View:
    turn, at = R_ned_body @ mounted.T_body_camera.rotation, position + R_ned_body @ mounted.T_body_camera.translation

    def draw(matrix: Array, size: tuple[int, int], R_lens_part: Array) -> View:
        return renderer.render(
            matrix, size, turn @ R_lens_part, at,
            drone_rotations=turned, drone_positions=places, shown=range(len(places)),
        )  # fmt: skip

    return lens_view(mounted.camera, draw)


def _place(world: World, flown: Array, rng: np.random.Generator) -> Array:
    """(3,) by which all drones (n, 3) are moved: clear of obstacles, as high above the world's ground as they were."""
    for place in world.free_points(_PLACES, rng, 2.0):
        level = flown[:, :2] - flown[0, :2] + place
        if np.abs(level).max() > world.extent_m or world.obstacle_distance(level).min() < _CLEARANCE_M:
            continue
        ground = world.height_at(level[:, 0], level[:, 1])
        up = float(ground[0])
        if (-flown[:, 2] + up - ground).min() > 0.6:
            return np.array([*(place - flown[0, :2]), -up])
    raise ValueError("no place in the world is clear of obstacles for all drones of a moment")


def _neighbours(moment: Moment) -> Array:
    return np.array([[one.poses[k].position for one in moment.neighbours] for k in range(2)])


def _vehicles(moment: Moment, up_m: Sequence[float], below_m: Sequence[float]) -> tuple[VehicleState, VehicleState]:
    """Exact attitude; a barometer that is off by the same in both; a range finder that errs by itself each time."""
    rng = np.random.Generator(np.random.PCG64([moment.seed, moment.number, 4]))
    off_m, errors = rng.normal(0.0, BAROMETER_SIGMA_M), rng.normal(0.0, RANGE_SIGMA_M, 2)
    first, second = (
        VehicleState(
            k * STEP_S,
            moment.own[k].rotation,
            float(up_m[k] + off_m),
            ground_range=RangeReading(k * STEP_S, float(below_m[k] + errors[k])) if math.isfinite(below_m[k]) else None,
        )
        for k in range(2)
    )
    return first, second
