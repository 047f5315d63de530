"""How well a whole rig knows its own motion in worlds that it never saw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.core.config import DroneConfig
from flockd.core.messages import Frame, FrameSet, VehicleState
from flockd.flight.geometry import Rig, build_rig
from flockd.flight.perception import Networks
from flockd.flight.pilot import FlockPilot
from flockd.sim.renderer import Renderer
from flockd.sim.world import World
from tools.measure.evaluation.on_pairs import HEIGHT_SIGMAS_M
from tools.training.scenes import drawn_attitude

Array = NDArray[Any]
STEP_M, STEP_S = 0.5, 0.5
CLEARANCE_M = 2.0
HEIGHTS_M = (2.0, 6.0)
NOISE = 2.0
"""Grey levels."""


def ego_motion_errors(
    config: DroneConfig, perception: Networks, seeds: Sequence[int], steps_a_world: int
) -> dict[str | None, list[float]]:
    """Translation errors in metres of single steps, by what measured the height (None: the network alone fixes the
    scale); NaN where there was no estimate.
    """
    errors: dict[str | None, list[float]] = {given: [] for given in (None, *HEIGHT_SIGMAS_M)}
    for seed in seeds:
        for steps, moved, wrong in _steps(seed, steps_a_world, build_rig(config.rig)):
            R_ned_body = steps[0][1].R_ned_body
            for given, found in errors.items():
                settings = config.perception.model_copy(update={"scale": "height" if given else "network"})
                pilot = FlockPilot(config.model_copy(update={"perception": settings}), perception)
                off_m = HEIGHT_SIGMAS_M.get(given or "", 0.0) * wrong
                ego = [
                    pilot.step(frames, replace(vehicle, height_m=vehicle.height_m + off_m)) for frames, vehicle in steps
                ][-1].ego_motion
                found.append(np.nan if ego is None else float(np.linalg.norm(R_ned_body @ ego.translation - moved)))
    return errors


def _steps(seed: int, count: int, rig: Rig) -> Iterator[tuple[list[tuple[FrameSet, VehicleState]], Array, float]]:
    """What a pilot is given before and after a step, and the step (3,) m NED, from places all over a world.

    And by how many standard deviations the height's measurement errs.
    """
    rng = np.random.Generator(np.random.PCG64([seed, 3]))
    world = World.generate(seed, ground_relief_m=float(rng.choice([0.0, 0.1, 0.2, 0.3])), keep_out=None)
    renderer = Renderer(world, [])
    for place in world.free_points(count, rng, CLEARANCE_M):
        ground = float(world.height_at(place[:1], place[1:2])[0])
        height, heading = float(rng.uniform(*HEIGHTS_M)), float(rng.uniform(-np.pi, np.pi))
        start = np.array([place[0], place[1], -(ground + height)])
        moved = np.array([STEP_M * np.cos(heading), STEP_M * np.sin(heading), 0.0])
        R_ned_body, wrong = drawn_attitude(rng), float(rng.standard_normal())
        steps = []
        for k in range(2):
            frames = _photographed(renderer, rig, R_ned_body, start + k * moved, k, rng)
            steps.append((FrameSet(k * STEP_S, frames), VehicleState(k * STEP_S, R_ned_body, height)))
        yield steps, moved, wrong


def _photographed(
    renderer: Renderer, rig: Rig, R_ned_body: Array, position: Array, k: int, rng: np.random.Generator
) -> dict[str, Frame]:
    frames = {}
    for name, mounted in rig.cameras.items():
        view = renderer.render(
            mounted.camera.matrix, mounted.camera.size, R_ned_body @ mounted.T_body_camera.rotation,
            position + R_ned_body @ mounted.T_body_camera.translation,
            drone_rotations=np.empty((0, 3, 3)), drone_positions=np.empty((0, 3)), shown=(),
        )  # fmt: skip
        noisy = view.rgb + rng.normal(0, NOISE, view.rgb.shape)
        frames[name] = Frame(name, np.clip(np.round(noisy), 0, 255).astype(np.uint8), k * STEP_S, k)
    return frames
