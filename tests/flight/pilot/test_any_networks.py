"""The pilot with networks that say anything: commands within the limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from random import Random
from typing import Any

import numpy as np
import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.safety import GateParameters
from flockd.core.messages import Frame, FrameSet, PilotOutput, VehicleState
from flockd.flight.geometry import rotation_from_euler
from flockd.flight.perception import load_networks
from flockd.flight.pilot import FlockPilot
from flockd.flight.safety import Action, Gate
from tests import make
from tests.flight.safety.test_gate_properties import assert_safe
from tests.hostile import CORPUS, any_float, hostile

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers near the largest overflow
STEPS = 4
"""Steps of one pilot: the second pairs frames, the others have tracks."""
ROUNDING = 1e-6


def test_whatever_networks_say_commands_are_finite_and_within_limits() -> None:
    config = load_drone(CORPUS / "drone.yaml", {"perception.flow": "flow_int8", "perception.threads": 1})
    networks = load_networks(config.perception)
    source = Random(0)
    for model in networks._models._opened.values():
        outputs = {name: spec.shape for name, spec in model.manifest.outputs.items()}
        model._runtime.run = _invented(outputs, lambda: source)  # type: ignore[method-assign]
    size = config.rig.cameras[0].size_px

    @hostile(6)
    def check(random: Random) -> None:
        source.seed(random.getrandbits(32))
        pilot = FlockPilot(config, networks)
        gate = Gate(config.safety.gate)
        time_s = 1000.0
        for number in range(STEPS):
            time_s += random.choice((0.5, 0.5, 0.5, 0.1, 0.0, -1.0, 1e-9))
            pixels = np.random.default_rng(random.getrandbits(32)).integers(0, 256, (size[1], size[0], 3), np.uint8)
            stamp = time_s if random.random() < 0.97 else any_float(random)
            frames = FrameSet(stamp, {"front": Frame("front", pixels, stamp, number)})
            try:
                output = pilot.step(frames, _vehicle(random, stamp))
            except FloatingPointError:  # of a network; the daemon discards the step and counts it
                continue
            _assert_within_limits(output, config)
            _through_gate(random, gate, config.safety.gate, output, time_s)

    check()


def _invented(shapes: Mapping[str, Any], random: Callable[[], Random]) -> Callable[..., list[Any]]:
    """Outputs of a network: the right shapes, and any numbers."""

    def run(names: list[str], feeds: Mapping[str, Any]) -> list[Any]:
        sizes = [size for feed in feeds.values() for size in feed.shape]
        batch, height, width = sizes[0], max(sizes[1:]), max(sizes[1:])
        for feed in feeds.values():
            if feed.ndim == 4 and feed.shape[-1] == 3:
                height, width = feed.shape[1:3]
        return [_numbers(random(), _shape(shapes[name], batch, height, width)) for name in names]

    return run


def _shape(spec: tuple[int | str, ...], batch: int, height: int, width: int) -> tuple[int, ...]:
    """A manifest's shape with the free sizes filled in: `n`, and those of the image or of its half."""
    filled = []
    for size in spec:
        if isinstance(size, int):
            filled.append(size)
        else:
            whole = {"n": batch, "h": height, "w": width}[size[0]]
            filled.append(whole // int(size.partition("/")[2] or 1) if size[0] != "n" else whole)
    return tuple(filled)


def _numbers(random: Random, shape: tuple[int, ...]) -> Any:
    """Numbers of one kind all over, or with a few that are not."""
    rng = np.random.default_rng(random.getrandbits(32))
    scale = random.choice((0.0, 1e-6, 1.0, 1.0, 10.0, 10.0, 100.0, 1e6, 1e30))
    values = rng.normal(random.choice((0.0, 1.0, -5.0, 5.0)), scale, shape) if scale else np.zeros(shape)
    if random.random() < 0.3:
        count = random.choice((1, 5, 100))
        values.flat[rng.integers(0, max(values.size, 1), count)] = any_float(random)
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _vehicle(random: Random, time_s: float) -> VehicleState:
    R = np.linalg.qr(np.random.default_rng(random.getrandbits(32)).normal(size=(3, 3)))[0]
    if random.random() < 0.7:
        R = rotation_from_euler(0.0, 0.0, random.uniform(-math.pi, math.pi))
    if random.random() < 0.05:
        R = R * any_float(random)
    velocity = None if random.random() < 0.2 else np.array([any_float(random) for _ in range(3)])
    return VehicleState(time_s, R, random.choice((5.0, 5.0, any_float(random))), velocity)


def _assert_within_limits(output: PilotOutput, config: DroneConfig) -> None:
    command = output.command
    numbers = [*command.velocity, *command.acceleration, command.yaw_rad or 0.0]
    assert np.isfinite(numbers).all(), "a command is not finite"
    trim = 0.0 if config.autopilot is None else config.autopilot.max_velocity_trim_m_s
    limit_m_s = config.flocking.max_speed_m_s + trim
    assert math.hypot(*command.velocity) <= limit_m_s + ROUNDING, f"{command.velocity} is over {limit_m_s} m/s"
    for neighbour in output.neighbours:
        assert np.isfinite([*neighbour.position, *neighbour.velocity]).all(), "a neighbour is nowhere"


def _through_gate(random: Random, gate: Gate, p: GateParameters, output: PilotOutput, now_s: float) -> None:
    near = make.around(
        [any_float(random), any_float(random)], [any_float(random), any_float(random)],
        neighbours=[n.position for n in output.neighbours], yaw_rad=any_float(random), height_m=any_float(random),
        neighbour_velocities=np.array([n.velocity[:2] for n in output.neighbours]).reshape(-1, 2),
    )  # fmt: skip
    action = random.choice((Action.FLY, Action.FLY_DEGRADED))
    asked = make.request(now_s, action=action, surroundings=near, wanted=output.command, height_m=any_float(random))
    assert_safe(gate.step(now_s, asked), p, action, near)
