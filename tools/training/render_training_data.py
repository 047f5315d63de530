"""Render training pairs: two camera images a fraction of a second apart, with depth, drones and flow as truth.

python -m tools.training.render_training_data OUT --worlds 120 --pairs 30 --split training

A third of the scenes have birds and the like in them. Half of the drones of training worlds are of generated
shapes. With ``--families unseen`` the drones are of the families that no network is trained on. With
``--obstacles 0.4`` four in ten worlds have a forest or a village, with the camera between trunks and before walls.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.core.errors import UsageError
from flockd.sim.renderer.airframe import DroneModel
from flockd.sim.renderer.drone_models import drone_model
from flockd.sim.scenario import ObstaclesConfig
from flockd.sim.world.obstacle_worlds import LOWEST_CROWN_M, generate_obstacles
from flockd.sim.world.obstacles import Obstacles
from tools.training import worlds
from tools.training.dataset import FOCAL_PX, HEIGHT, MAX_DRONES, R_BODY_CAMERA, WIDTH, create_part, note
from tools.training.drone_generator import generated_drone

Array = NDArray[Any]
SHAPES_A_WORLD = 24
"""Shapes of the generator in a world, where drones are drawn from it."""
NEAREST_M = 1.2
"""To an obstacle: a camera moves by up to a metre within a pair."""
WITH_DISTRACTORS = 1 / 3
"""Share of the scenes."""


def main() -> None:
    """Render every world of the split in parallel, one part folder a world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", choices=["training", "validation", "test"], default="training")
    parser.add_argument("--families", choices=["training", "unseen"], default="training")
    parser.add_argument("--worlds", type=int, default=120)
    parser.add_argument("--pairs", type=int, default=30, help="pairs a world")
    parser.add_argument("--obstacles", type=float, default=0.0, metavar="SHARE", help="of the worlds; default: none")
    arguments = parser.parse_args()
    seeds = {"training": worlds.TRAINING, "validation": worlds.VALIDATION, "test": worlds.TEST}[arguments.split]
    families = {"training": worlds.FAMILIES, "unseen": worlds.UNSEEN_FAMILIES}[arguments.families]
    share = worlds.SHAPES_SHARE if (arguments.split, arguments.families) == ("training", "training") else 0.0
    jobs = [
        PairJob(arguments.out / f"part-{i:04d}", seeds[i], arguments.pairs, families, share, arguments.obstacles)
        for i in range(arguments.worlds)
    ]
    missing = [job for job in jobs if not (job.folder / "made.json").is_file()]
    worlds.in_processes(render_world, missing)


@dataclass(frozen=True)
class PairJob:
    """One part of a folder of pairs."""

    folder: Path
    seed: int
    """Seed of the world."""
    pairs: int
    families: range
    shapes_share: float = 0.0
    """Share of the drones that are of the generator's shapes instead."""
    obstacles_share: float = 0.0
    """How likely a world has a forest or a village."""


def render_world(job: PairJob) -> None:
    """One part."""
    from flockd.sim.cameras.camera_simulator import FIELD_GRID_M, field_grid  # noqa: PLC0415 - numba starts in the worker
    from flockd.sim.world.world import World  # noqa: PLC0415

    folder, seed, count = job.folder, job.seed, job.pairs
    rng = np.random.Generator(np.random.PCG64(seed))
    field, obstacles = _standing(worlds.drawn_obstacles(seed, job.obstacles_share), seed)
    world = World.generate(
        seed,
        ground_relief_m=float(rng.choice([0.0, 0.1, 0.2, 0.3])),
        keep_out=None if field is None else field_grid(field.extent_m),
        clearance_m=9.0 if field is None else FIELD_GRID_M,
        obstacles=obstacles,
    )
    drawn = rng.choice(worlds.SHAPES, SHAPES_A_WORLD) if job.shapes_share else ()
    shapes = [generated_drone(int(shape), int(rng.integers(1 << 31))) for shape in drawn]
    part = create_part(folder, count)
    places = world.free_points(count, rng, 2.0) if field is None else _places_among(world, count, rng, field.extent_m)
    highest_m = 8.0 if field is None else LOWEST_CROWN_M - 0.5
    for index in range(count):
        drones = [_drawn_drone(job, shapes, rng) for _ in range(MAX_DRONES)]
        families = np.array([drone.family for drone in drones])
        _render_pair(drones, world, places[index], highest_m, families, part, index, rng)
    for array in part.values():
        array.flush()  # type: ignore[attr-defined]
    note(
        folder, seed=seed, pairs=count, families=list(job.families), shapes_share=job.shapes_share,
        obstacles=None if field is None else field.kind,
    )  # fmt: skip


def _standing(field: ObstaclesConfig | None, seed: int) -> tuple[ObstaclesConfig | None, Obstacles | None]:
    """The drawn obstacles with their places; as long as there is no room, a fifth fewer."""
    if field is None:
        return None, None
    while True:
        try:
            return field, generate_obstacles(field, seed, np.zeros((0, 2)))
        except UsageError:
            fewer = {key: 0.8 * getattr(field, key) for key in ("houses_per_hectare", "trees_per_hectare")}
            field = field.model_copy(update=fewer)


def _places_among(world: Any, count: int, rng: np.random.Generator, extent_m: float) -> Array:
    """Places (count, 2) between obstacles; half are the nearest to obstacles of four times as many."""
    free = world.free_points(4 * count, rng, NEAREST_M, within_m=extent_m)
    near = free[np.argsort(world.obstacle_distance(free))[: count // 2]]
    return np.concatenate([near, free[rng.permutation(len(free))[: count - len(near)]]])


def _drawn_drone(job: PairJob, shapes: list[DroneModel], rng: np.random.Generator) -> DroneModel:
    if rng.random() < job.shapes_share:
        return shapes[int(rng.integers(len(shapes)))]
    return drone_model(int(rng.choice(job.families)), int(rng.integers(1 << 31)))


def _render_pair(
    drones: list[DroneModel],
    world: Any,
    place: Array,
    highest_m: float,
    families: Array,
    part: dict[str, Array],
    index: int,
    rng: np.random.Generator,
) -> None:
    from flockd.sim.renderer.renderer import Renderer, true_flow  # noqa: PLC0415

    focal = FOCAL_PX * float(np.exp(rng.normal(0, 0.08)))
    matrix = np.array([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    height = float(rng.uniform(1.5, highest_m))
    ground = float(world.height_at(place[:1], place[1:2])[0])
    position = np.array([place[0], place[1], -(ground + height)])
    start = worlds.drawn_attitude(rng)
    interval = float(rng.uniform(0.1, 0.5))
    velocity = np.append(_direction(rng) * rng.uniform(0, 2.0), rng.normal(0, 0.2))
    turn = worlds.attitude(rng.normal(0, np.radians(10)) * interval, rng.normal(0, np.radians(4), 2) * interval)
    positions = [position, position + velocity * interval]
    attitudes = [start, start @ turn]
    shown = np.arange(MAX_DRONES) < rng.choice([0, 1, 2, 3, 4, 5, 6], p=[0.05, 0.15, 0.2, 0.2, 0.15, 0.15, 0.1])
    places = _drone_places(position, start, focal, rng)
    places[:, 2] = np.minimum(places[:, 2], -(ground + 0.5))
    moves = (velocity + rng.normal(0, 0.4, (MAX_DRONES, 3))) * interval
    turns = [worlds.drawn_attitude(rng) for _ in range(MAX_DRONES)]
    wobble = [worlds.attitude(rng.normal(0, 0.1) * interval, rng.normal(0, 0.07, 2)) for _ in range(MAX_DRONES)]
    places[~shown] = np.nan
    drone_positions = [places, places + moves]
    drone_rotations = [np.array(turns), np.array([r @ w for r, w in zip(turns, wobble, strict=True)])]
    count = int(rng.integers(1, 5)) if rng.random() < WITH_DISTRACTORS else 0
    others = worlds.drawn_distractions(count, position, start @ R_BODY_CAMERA, focal, ground, rng)
    views, nobody = [], np.zeros((2, HEIGHT, WIDTH), dtype=bool)
    for k in range(2):
        R_ned_camera = attitudes[k] @ R_BODY_CAMERA
        besides = [other.at(k * interval) for other in others]
        view = Renderer(world, [*drones, *(thing for thing, _, _ in besides)]).render(
            matrix, (WIDTH, HEIGHT), R_ned_camera, positions[k],
            drone_rotations=np.array([*drone_rotations[k], *(turned for _, turned, _ in besides)]),
            drone_positions=np.array([*drone_positions[k], *(place for _, _, place in besides)]),
            shown=np.append(shown, np.ones(count, dtype=bool)),
        )  # fmt: skip
        nobody[k] = view.ids > MAX_DRONES
        view = replace(view, ids=np.where(nobody[k], 0, view.ids).astype(np.uint8))
        views.append(view)
        part["image"][index, k] = view.rgb
        part["depth"][index, k] = np.minimum(view.depth[1::2, 1::2], 1000.0)
        part["ids"][index, k] = view.ids[1::2, 1::2]
        part["R_ned_camera"][index, k] = R_ned_camera
        part["height"][index, k] = -positions[k][2] - world.height_at(positions[k][:1], positions[k][1:2])[0]
        part["drone_centre"][index, k] = centres = (drone_positions[k] - positions[k]) @ R_ned_camera
        for d in np.flatnonzero(shown).tolist():
            rows, columns = np.nonzero(view.ids == d + 1)
            part["drone_pixels"][index, k, d] = rows.size
            if rows.size:
                part["drone_box"][index, k, d] = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
            corners = drones[d].vertices @ drone_rotations[k][d].T @ R_ned_camera + centres[d]
            part["drone_whole"][index, k, d] = worlds.is_whole(corners, view, matrix, d + 1, drones[d].size_m)
    flow, valid = true_flow(
        views[0], views[1], matrix,
        R_ned_camera=(attitudes[0] @ R_BODY_CAMERA, attitudes[1] @ R_BODY_CAMERA),
        position_ned=(positions[0], positions[1]),
        drone_rotations=(drone_rotations[0], drone_rotations[1]),
        drone_positions=(drone_positions[0], drone_positions[1]),
    )  # fmt: skip
    part["flow"][index] = np.moveaxis(flow[1::2, 1::2], 2, 0)
    part["flow_valid"][index] = (valid & ~nobody[0])[1::2, 1::2]  # wings beat
    part["focal"][index] = focal
    part["drone_family"][index] = families


def _drone_places(position: Array, attitude: Array, focal: float, rng: np.random.Generator) -> Array:
    """Drones all over the picture, most of them near, a few across its borders."""
    u = rng.uniform(-20, WIDTH + 20, MAX_DRONES) - WIDTH / 2
    v = np.clip(rng.normal(HEIGHT / 2, HEIGHT / 5, MAX_DRONES), 0, HEIGHT) - HEIGHT / 2
    rays = np.stack([u / focal, v / focal, np.ones(MAX_DRONES)], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges = np.where(
        rng.random(MAX_DRONES) < 0.75,
        np.exp(rng.uniform(np.log(1.2), np.log(7.0), MAX_DRONES)),
        rng.uniform(7.0, 20.0, MAX_DRONES),
    )
    return np.asarray(position + (rays * ranges[:, None]) @ (attitude @ R_BODY_CAMERA).T)


def _direction(rng: np.random.Generator) -> Array:
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


if __name__ == "__main__":
    main()
