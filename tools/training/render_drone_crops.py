"""Render crops of single drones for the distance network: many more than whole images would give.

    python -m tools.training.render_drone_crops OUT --worlds 300 --scenes 300
    python -m tools.training.render_drone_crops OUT --mesh MY.glb --size-m 0.55 --worlds 40
    python -m tools.training.render_drone_crops OUT --cut-out --worlds 100 --scenes 60

Only the window of the camera's image that the crops show is drawn. Every drone stands in another place. One file a
world. With --mesh (glTF) that drone alone flies. With --held-out, in test worlds and with ranges, that
drone, or the families that no network learns from. With --cut-out OUT receives drones to be put onto photographs, for
`detector` and `verification`: PNGs, 320 px wide and high with straight alpha, and `index.jsonl`, whose lines name them
as `file`. The shipped networks learnt from a folder of the same form that Blender's Cycles had rendered.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.sim.renderer.airframe import DroneModel, Solid
from flockd.sim.renderer.drone_models import drone_model
from tools.training import worlds
from tools.training.dataset import FOCAL_PX, HEIGHT, R_BODY_CAMERA, WIDTH
from tools.training.drone_generator import generated_drone
from tools.training.own_mesh import painted, read_meshes
from tools.training.samples import DroneInView, crop_around, crop_at, sample_of, sample_without_drone

Array = NDArray[Any]
PICTURES_A_SCENE = 3
PAINTED, SHAPES_PAINTED, OWN_PAINTED = 8, 3, 12
"""Drones of each family, of each generated shape and of a mesh in a world, painted differently."""
MOST_DRONES = 3
MIN_PIXELS = 8
"""Least visible pixels of a drone: one that is six pixels wide still differs from a bird."""
WITH_DISTRACTORS, DISTRACTOR_ALONE = 0.3, 0.1
"""Shares of the scenes: a bird or the like before or behind the drone, and in its place, where half are too far."""
CUT_PX, FINER = 320, 3
"""A cut-out is rendered so many times as large, for soft edges."""
CUT_FILL, CUT_RANGES_M, CUT_HEIGHTS_M = (0.75, 0.95), (1.2, 12.0), (15.0, 40.0)
"""Of a cut-out: share of its width that the drone's size takes; from how far it is seen, and how high it flies."""


@dataclass(frozen=True, eq=False)
class CropJob:
    """One file of crops, or the cut-outs of one world."""

    file: Path
    """Of cut-outs the last one."""
    seed: int
    """Seed of the world."""
    scenes: int
    own: Sequence[DroneModel]
    """The drone that flies alone, in several states; empty: many kinds fly."""
    measures: bool
    """Also store `range_m`, and whether the drone is `whole`: inside the image and not hidden."""


def main() -> None:
    """Render every world, one file each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--worlds", type=int, default=300)
    parser.add_argument("--scenes", type=int, default=400, help="drones a world")
    parser.add_argument("--mesh", type=Path, nargs="+", help="of a drone, with propellers and colours; several: any")
    parser.add_argument("--size-m", type=float, help="of --mesh: widest horizontal distance, propeller tip to tip, m")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--held-out", action="store_true", help="to measure on, of drones and worlds never learnt from")
    kind.add_argument("--cut-out", action="store_true", help="drones with transparent surroundings")
    arguments = parser.parse_args()
    own = own_drone(parser, arguments)
    arguments.out.mkdir(parents=True, exist_ok=True)
    # From the far end of the training worlds: other places than those of whole images.
    split = worlds.TEST if arguments.held_out else worlds.TRAINING
    ending = f"_{arguments.scenes - 1:04d}.png" if arguments.cut_out else ".npz"
    files = {seed: arguments.out / f"{seed}{ending}" for seed in split[::-1][: arguments.worlds]}
    jobs = [
        CropJob(file, seed, arguments.scenes, own, measures=arguments.held_out)
        for seed, file in files.items()
        if not file.is_file()
    ]
    worlds.in_processes(_cut_world if arguments.cut_out else _render_world, jobs)
    if arguments.cut_out:
        names = sorted(file.name for file in arguments.out.glob("*.png"))
        (arguments.out / "index.jsonl").write_text("".join(json.dumps({"file": name}) + "\n" for name in names))


def own_drone(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> list[DroneModel]:
    """The drone of ``--mesh``, in several states; empty without it."""
    if not arguments.mesh:
        return []
    if arguments.size_m is None:
        parser.error("--mesh needs --size-m, the drone's size: a mesh's unit and a range are nothing without it")
    try:
        drones = read_meshes(arguments.mesh, arguments.size_m)
    except ValueError as error:
        parser.error(str(error))
    for path, drone in zip(arguments.mesh, drones, strict=True):
        plain = float(np.isnan(drone.colours).any(axis=1).mean())
        print(f"{path}: has no colours for {plain:.0%} of its triangles{'; they get a drawn one' * (plain > 0)}")
    return drones


def _drawn_models(
    own: Sequence[DroneModel], rng: np.random.Generator, *, measures: bool = False
) -> list[list[DroneModel]]:
    """Shapes, each painted in several ways: of ``own``, of the unseen families to measure on, or of the training's
    families and as many shapes of the generator as the drones of a world are to have."""
    if own:
        return [[painted(own[k % len(own)], _paint(rng)) for k in range(OWN_PAINTED)]]
    names = worlds.UNSEEN_FAMILIES if measures else worlds.FAMILIES
    families = [[drone_model(family, _paint(rng)) for _ in range(PAINTED)] for family in names]
    share = 0.0 if measures else worlds.SHAPES_SHARE
    drawn = rng.choice(worlds.SHAPES, round(len(families) * share / (1 - share)))
    return families + [[generated_drone(int(shape), _paint(rng)) for _ in range(SHAPES_PAINTED)] for shape in drawn]


def _paint(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 31))


def _render_world(job: CropJob) -> None:
    from flockd.sim.world.world import World  # noqa: PLC0415 - numba starts in the worker

    rng = np.random.Generator(np.random.PCG64([job.seed, 1]))
    world = World.generate(job.seed, ground_relief_m=float(rng.choice([0.0, 0.1, 0.2, 0.3])), keep_out=None)
    places = world.free_points(job.scenes, rng, 2.0)
    models = _drawn_models(job.own, rng, measures=job.measures)
    samples = [sample for place in places for sample in _scene(world, place, models, rng, measures=job.measures)]
    joined = {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}
    draft = job.file.with_suffix(".part")
    with draft.open("wb") as file:
        np.savez(file, allow_pickle=False, **joined)
    draft.replace(job.file)


def _scene(
    world: Any, place: Array, models: list[list[DroneModel]], rng: np.random.Generator, *, measures: bool
) -> list[dict[str, Array]]:
    """Pictures of one drone from one camera; other drones and distractors may stand before or behind it."""
    from flockd.sim.renderer.renderer import Renderer  # noqa: PLC0415

    focal = FOCAL_PX * float(np.exp(rng.normal(0, 0.08)))
    ground = float(world.height_at(place[:1], place[1:2])[0])
    position = np.array([place[0], place[1], -(ground + rng.uniform(1.5, 8.0))])
    R_ned_camera = worlds.drawn_attitude(rng) @ R_BODY_CAMERA
    count = int(rng.choice([1, 2, MOST_DRONES], p=[0.6, 0.25, 0.15]))
    shapes = rng.choice(len(models), count)
    drones = [models[shape][int(rng.integers(len(models[shape])))] for shape in shapes]
    positions = _places(position, R_ned_camera, focal, count, rng)
    positions[:, 2] = np.minimum(positions[:, 2], -(ground + 0.5))
    rotations = np.array([worlds.drawn_attitude(rng) for _ in range(count)])
    seen = DroneInView(focal, R_ned_camera.T @ (positions[0] - position), R_ned_camera.T @ rotations[0], drones[0])
    if seen.centre[2] < 0.3:
        return []
    alone, beside = rng.random() < DISTRACTOR_ALONE, rng.random() < WITH_DISTRACTORS
    others: list[tuple[Solid, Array, Array]] = []
    if alone or beside:
        ray = positions[0] - position + (0.0 if alone else 0.25) * rng.normal(0, 0.5, 3)
        others = [worlds.drawn_distraction(position, ray / np.linalg.norm(ray), ground, rng).at(0.0)]
    if alone:
        positions[:] = np.nan  # nobody, and nobody's shadow
        centre = R_ned_camera.T @ (others[0][2] - position)
        if centre[2] < 0.3:
            return []
        crops = [crop_at(centre, others[0][0].size_m, focal, rng) for _ in range(PICTURES_A_SCENE)]
    else:
        crops = [crop_around(seen, rng) for _ in range(PICTURES_A_SCENE)]
    left, top, right, bottom = _window(crops)
    matrix = np.array([[focal, 0.0, WIDTH / 2 - left], [0.0, focal, HEIGHT / 2 - top], [0.0, 0.0, 1.0]])
    view = Renderer(world, [*drones, *(thing for thing, _, _ in others)]).render(
        matrix, (right - left, bottom - top), R_ned_camera, position,
        drone_rotations=np.array([*rotations, *(turned for _, turned, _ in others)]),
        drone_positions=np.array([*positions, *(at for _, _, at in others)]),
        shown=np.append(np.full(count, not alone), np.ones(len(others), dtype=bool)),
    )  # fmt: skip
    if np.count_nonzero(view.ids > count if alone else view.ids == 1) < MIN_PIXELS:
        return []
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[top:bottom, left:right] = view.rgb
    mine = np.zeros((HEIGHT, WIDTH), np.bool_)
    if alone:
        samples = [sample_without_drone(crop, image) for crop in crops]
    else:
        mine[top:bottom, left:right] = view.ids == 1
        samples = [sample_of(seen, crop, image, mine) for crop in crops]
    if not measures:
        return samples
    corners = drones[0].vertices @ seen.rotation.T + seen.centre
    whole = not alone and worlds.is_whole(corners, view, matrix, 1, drones[0].size_m, (left, top))
    return [{**s, "range_m": np.array(np.linalg.norm(seen.centre)), "whole": np.array(whole)} for s in samples]


def _places(position: Array, R_ned_camera: Array, focal: float, count: int, rng: np.random.Generator) -> Array:
    """Places (count, 3), NED m: the first drone in the picture or just outside, the others near its direction."""
    u = rng.uniform(-15, WIDTH + 15) - WIDTH / 2
    v = np.clip(rng.normal(HEIGHT / 2, HEIGHT / 5), 0, HEIGHT) - HEIGHT / 2
    rays = np.array([[u / focal, v / focal, 1.0]]) + np.vstack([np.zeros(3), rng.normal(0, 0.12, (count - 1, 3))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    near = np.exp(rng.uniform(np.log(1.2), np.log(7.0), count))
    ranges = np.where(rng.random(count) < 0.75, near, rng.uniform(7.0, 20.0, count))
    return np.asarray(position + (rays * ranges[:, None]) @ R_ned_camera.T)


def _window(crops: list[Any]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the part of the image that the crops look at."""
    edge = np.array([[u, v] for u in np.linspace(0, 96, 7) for v in np.linspace(0, 96, 7)])
    pixels = np.vstack(
        [
            crop.rig.cameras["camera"].camera.project(
                np.insert((edge - 48.0) / crop.focal_px, 2, 1.0, axis=1) @ crop.R_body_virtual[0].T @ R_BODY_CAMERA
            )
            for crop in crops
        ]
    )
    low = np.clip(np.floor(np.nanmin(pixels, 0)) - 3, 0, (WIDTH - 8, HEIGHT - 8)).astype(int)
    high = np.clip(np.ceil(np.nanmax(pixels, 0)) + 3, low + 8, (WIDTH, HEIGHT)).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _cut_world(job: CropJob) -> None:
    from flockd.sim.world.world import World  # noqa: PLC0415 - numba starts in the worker

    rng = np.random.Generator(np.random.PCG64([job.seed, 2]))
    world = World.generate(job.seed, ground_relief_m=0.0, keep_out=None)
    models = _drawn_models(job.own, rng)
    for number in range(job.scenes):
        shape = models[int(rng.integers(len(models)))]
        image = cut_out(world, shape[int(rng.integers(len(shape)))], rng)
        cv2.imwrite(str(job.file.with_name(f"{job.seed}_{number:04d}.png")), image[..., [2, 1, 0, 3]])


def cut_out(world: Any, drone: DroneModel, rng: np.random.Generator) -> NDArray[np.uint8]:
    """(320, 320, 4) RGBA of a drone from anywhere, alpha straight."""
    from flockd.sim.renderer.renderer import Renderer  # noqa: PLC0415

    side = FINER * CUT_PX
    range_m = float(np.exp(rng.uniform(*np.log(CUT_RANGES_M))))
    focal = side * rng.uniform(*CUT_FILL) * range_m / drone.size_m
    matrix = np.array([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    pitch = np.arcsin(rng.uniform(-1.0, 1.0)) if rng.random() < 0.2 else rng.uniform(-0.9, 0.9)
    R_ned_camera = worlds.attitude(rng.uniform(-np.pi, np.pi), np.array([rng.normal(0, 0.15), pitch])) @ R_BODY_CAMERA
    place = np.array([0.0, 0.0, -rng.uniform(*CUT_HEIGHTS_M)])
    view = Renderer(world, [drone]).render(
        matrix, (side, side), R_ned_camera, place - range_m * R_ned_camera[:, 2],
        drone_rotations=worlds.drawn_attitude(rng)[None], drone_positions=place[None], shown=[0],
    )  # fmt: skip
    mine = (view.ids == 1).astype(np.float32)[:, :, None]
    small = cv2.resize(np.dstack([view.rgb * mine, 255.0 * mine]), (CUT_PX, CUT_PX), interpolation=cv2.INTER_AREA)
    colour = 255.0 * small[..., :3] / np.maximum(small[..., 3:], 1.0)
    return np.asarray(np.clip(np.rint(np.dstack([colour, small[..., 3:]])), 0, 255), np.uint8)


if __name__ == "__main__":
    main()
