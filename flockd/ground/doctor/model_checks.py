"""Checks models: hash, golden output, provider, and the duration of a step."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Iterator

import cv2
import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.errors import ModelError
from flockd.core.messages import Frame, FrameSet, PilotOutput, UInt8Array, VehicleState
from flockd.flight.inference import OnnxModel, manifests_of
from flockd.flight.inference.providers import engines_folder
from flockd.flight.perception import Networks
from flockd.flight.pilot import FlockPilot
from flockd.ground.doctor import Finding, Level, failed_from_error, graded, passed
from flockd.onboard.daemon import load_side_by_side
from flockd.onboard.worker import GOLDEN_S, within

STEPS = 4
"""Number of steps that are timed. The first one has no previous images and warms up."""
FULL = 0.8
"""Share of `safety.degraded_load` above which a step's duration is a warning: each further neighbour takes time."""
HEIGHT_M = 5.0
PASSING_PX = 4
SKY = (170, 190, 215)
GRASS = (80, 130)


def check_models(config: DroneConfig) -> Iterator[Finding]:
    """Checks each model of the configuration, and then the duration of a step with all of them."""
    intact = True
    for finding in _each(config):
        intact = intact and finding.level is not Level.FAILURE
        yield finding
    if intact:
        yield judge_steps(config, time_steps(config), os.getloadavg()[0], os.cpu_count() or 1)


def _each(config: DroneConfig) -> Iterator[Finding]:
    wanted = config.perception
    for path in manifests_of(wanted):
        about = f"model {path.stem}"
        try:
            model = OnnxModel(
                path,
                threads=wanted.threads,
                provider=wanted.provider,
                engines=engines_folder(wanted),
                deadline=within(GOLDEN_S),
            )
        except ModelError as error:
            yield failed_from_error(about, str(error))
            continue
        size_mb = path.with_name(model.manifest.file).stat().st_size / 1e6
        yield passed(about, f"hash and golden output are right, {size_mb:.1f} MB, run by {model.provider}")


def time_steps(config: DroneConfig, networks: Networks | None = None) -> list[tuple[float, PilotOutput]]:
    """Steps of the pilot over an empty meadow, at the size of the cameras: seconds, and the output."""
    pilot = FlockPilot(config, networks or load_side_by_side(config), stopwatch=time.perf_counter)
    timed = []
    for number in range(STEPS):
        time_s = number * config.step_s
        frames = {
            camera.name: Frame(camera.name, meadow(camera.size_px, number), time_s, number)
            for camera in config.rig.cameras
        }
        vehicle = VehicleState(time_s, np.eye(3), HEIGHT_M, np.zeros(3))
        begun_s = time.perf_counter()
        output = pilot.step(FrameSet(time_s, frames), vehicle)
        timed.append((time.perf_counter() - begun_s, output))
    return timed


def meadow(size: tuple[int, int], number: int) -> UInt8Array:
    """Sky above grass that moves sideways from image to image, (height, width, 3) RGB."""
    width, height = size
    image = np.empty((height, width, 3), np.uint8)
    image[: height // 2] = SKY
    wide = width + STEPS * PASSING_PX
    grass = np.random.default_rng(0).integers(*GRASS, (height // 4, wide // 2, 3), dtype=np.uint8)
    grass = np.asarray(cv2.resize(grass, (wide, height - height // 2)), np.uint8)
    image[height // 2 :] = grass[:, number * PASSING_PX :][:, :width]
    return image


FASTER = "give perception.threads more cores, raise step_s, take smaller images, or `perception.flow: dis`"


def judge_steps(config: DroneConfig, timed: list[tuple[float, PilotOutput]], busy: float, cores: int) -> Finding:
    """Whether the steps leave time to spare; ``busy``: the load of the computer's ``cores``."""
    took_s = statistics.median(seconds for seconds, _ in timed[1:])
    stages = timed[-1][1].stages_ms
    longest = ", ".join(f"{stage} {stages[stage]:.0f}" for stage in sorted(stages, key=lambda s: -stages[s])[:3])
    count, threads = len(config.rig.cameras), config.perception.threads
    measured = (
        f"a step takes {1e3 * took_s:.0f} of {1e3 * config.step_s:.0f} ms with {threads} "
        f"{'threads' if threads > 1 else 'thread'} and {count} {'cameras' if count > 1 else 'camera'} ({longest})"
    )
    load = took_s / config.step_s
    fix = FASTER
    if busy > cores:
        fix = f"stop other programs first (a load of {busy:.0f} on {cores} cores), and {fix}"
    too_much, much = load > config.safety.degraded_load, load > FULL * config.safety.degraded_load
    if too_much:
        measured += ": above safety.degraded_load, so it would always fly slowly"
    elif much:
        measured += ": little time is left for other programs"
    return graded("step", measured, fix, failure=too_much, warning=much)
