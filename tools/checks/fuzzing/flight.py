"""What flies: the pilot with networks that say anything, the gate and the supervisor with inputs that cannot be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.safety import GateParameters, SafetyParameters
from flockd.core.messages import Frame, FrameSet, PilotOutput, VehicleState, Wanted
from flockd.flight.perception import load_networks
from flockd.flight.pilot import FlockPilot
from flockd.flight.safety import (
    OFFBOARD,
    Action,
    CameraHealth,
    Gate,
    Inputs,
    Permission,
    Request,
    State,
    Supervisor,
    Surroundings,
    Verdict,
    link_lost,
)
from tools.checks.fuzzing.mutation import any_float
from tools.checks.fuzzing.target import CORPUS, Check, Target

STEPS = 4
"""Steps of one pilot: the second pairs frames, the others have tracks."""
ROUNDING = 1e-6

# ---------------------------------------------------------------------------------------------------- network outputs


def _networks(folder: Path) -> Check:
    config = load_drone(CORPUS / "drone.yaml", {"perception.flow": "flow_int8", "perception.threads": 1})
    networks = load_networks(config.perception)
    source = Random(0)
    for model in networks._models._opened.values():
        outputs = {name: spec.shape for name, spec in model.manifest.outputs.items()}
        model._runtime.run = _invented(outputs, lambda: source)  # type: ignore[method-assign]
    size = config.rig.cameras[0].size_px

    def check(random: Random) -> None:
        source.setstate(random.getstate())
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

    return check


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
    if random.random() < 0.7:  # level, or nearly so
        angle = random.uniform(-math.pi, math.pi)
        R = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
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
    around = Surroundings(
        np.array([any_float(random), any_float(random)]),
        np.array([any_float(random), any_float(random)]),
        any_float(random),
        np.array([n.position for n in output.neighbours]).reshape(-1, 3),
        np.array([n.velocity[:2] for n in output.neighbours]).reshape(-1, 2),
        any_float(random),
    )
    action = random.choice((Action.FLY, Action.FLY_DEGRADED))
    request = Request(Permission(action, now_s), output.command, now_s, any_float(random), around)
    assert_safe(gate.step(now_s, request), p, action, around)


def assert_safe(verdict: Verdict, p: GateParameters, action: Action, around: Surroundings) -> None:
    """Raises AssertionError for a setpoint that is not finite or outside the limits."""
    setpoint = verdict.setpoint
    if setpoint is None:
        return
    assert action is not Action.SILENCE, "a setpoint without permission"
    assert np.isfinite([*setpoint.velocity, setpoint.height_m, setpoint.yaw_rad]).all(), "a setpoint is not finite"
    assert abs(setpoint.yaw_rad) <= math.pi, f"a heading of {setpoint.yaw_rad}"
    assert p.min_height_m <= setpoint.height_m <= p.max_height_m, "a height outside the band"
    assert math.hypot(*setpoint.velocity) <= p.max_speed_m_s + ROUNDING, "a setpoint is too fast"
    if np.isfinite(around.position).all() and p.fence_radius_m is not None:
        distance = math.hypot(*around.position)
        if p.fence_radius_m < distance < 1e100:
            outward = float(around.position / distance @ setpoint.velocity)
            assert outward <= ROUNDING, f"{outward} m/s out of the fence"
    separation_m = p.min_separation_m if action is Action.FLY else p.degraded_separation_m
    for offset in around.neighbours:
        level = math.hypot(*offset[:2])
        if np.isfinite(offset).all() and level > 0.1 and math.hypot(*offset) < separation_m - ROUNDING:
            assert offset[:2] / level @ setpoint.velocity <= ROUNDING, "towards a neighbour that is too near"


# -------------------------------------------------------------------------------------------------- gate, supervisor


def _gate(folder: Path) -> Check:
    parameters = (
        GateParameters(),
        GateParameters(fence_radius_m=None, fence_corners_m=((0, 0), (20, 0), (20, 20), (0, 20))),
        load_drone(CORPUS / "drone.yaml").safety.gate,
    )

    def check(random: Random) -> None:
        p = random.choice(parameters)
        gate, now_s = Gate(p), random.choice((0.0, 1e3, 1e9))
        for _ in range(random.randrange(1, 8)):
            now_s += random.choice((0.0, 0.05, 0.05, 0.05, 0.5, -0.1))
            two = [np.array([any_float(random), any_float(random)]) for _ in range(2)]
            yaw_rad, height_m = (None if random.random() < 0.2 else any_float(random) for _ in range(2))
            wanted = Wanted(two[0], two[1], yaw_rad, height_m=height_m)
            around = _surroundings(random)
            action = random.choice(list(Action))
            wanted_s = now_s - random.choice((0.0, 0.1, 1.0, 1.2, any_float(random)))
            permission = Permission(action, now_s - random.choice((0.0, 0.0, 0.0, any_float(random))))
            request = Request(permission, wanted, wanted_s, any_float(random), around)
            assert_safe(gate.step(now_s, request), p, action, around)

    return check


def _surroundings(random: Random) -> Surroundings:
    count = random.choice((0, 1, 1, 2, 5, 12))
    return Surroundings(
        np.array([any_float(random), any_float(random)]),
        np.array([any_float(random), any_float(random)]),
        any_float(random),
        np.array([any_float(random) for _ in range(3 * count)]).reshape(count, 3),
        np.array([any_float(random) for _ in range(2 * count)]).reshape(count, 2),
        any_float(random),
    )


_NUMBERS = tuple(field.name for field in dataclasses.fields(Inputs) if field.type == "float")
_FLAGS = tuple(field.name for field in dataclasses.fields(Inputs) if field.type == "bool")
_COUNTS = tuple(field.name for field in dataclasses.fields(Inputs) if field.type == "int")
_SEEN = ("stream_fault", "foreign_setpoints", "parameter_fault")
"""What was seen, in words; None: nothing."""


def _supervisor(folder: Path) -> Check:
    parameters = SafetyParameters()

    def check(random: Random) -> None:
        supervisor, now_s = Supervisor(parameters), 1000.0
        inputs = _quiet()
        for _ in range(random.randrange(1, 40)):
            now_s += random.choice((0.0, 0.05, 0.1, 1.0, 5.0))
            inputs = dataclasses.replace(inputs if random.random() < 0.7 else _quiet(), **_changes(random))
            decision = supervisor.step(now_s, inputs)
            moves = decision.action in (Action.FLY, Action.FLY_DEGRADED)
            if moves:
                assert inputs.flight_mode == OFFBOARD, "flies although the pilot does"
                assert inputs.armed, "flies although it is not armed"
                assert link_lost(inputs.heartbeat_age_s, inputs.message_age_s, parameters) is None, (
                    "flies without a link"
                )
                assert inputs.estimate_age_s <= parameters.estimate_timeout_s, "flies blindly"
                assert not (inputs.shutdown_asked or inputs.hold_asked or inputs.land_asked), "flies on"
            if decision.action is not Action.SILENCE and decision.state is not State.READY:
                assert inputs.flight_mode == OFFBOARD, "sends although the pilot flies"
            assert all(reason.sentence for reason in decision.reasons)

    return check


def _quiet() -> Inputs:
    """An undisturbed flight, on the ground or in the air by what is changed."""
    sees = CameraHealth(age_s=0.02, period_s=0.033, unplugged=False, frozen=False, noisy=False)
    fine: dict[str, Any] = dict.fromkeys(_NUMBERS, 0.01) | dict.fromkeys(_FLAGS, False) | dict.fromkeys(_COUNTS, 0)
    fine |= dict.fromkeys(_SEEN)
    fine |= {"nearest_neighbour_m": 3.0, "cameras": {"front": sees, "back": sees}, "temperature_c": 50.0}
    return Inputs(**fine, dead_tasks=(), flight_mode=OFFBOARD, armed=True, in_air=True)


def _changes(random: Random) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    for _ in range(random.choice((0, 0, 1, 2, 5))):
        match random.randrange(8):
            case 0:
                changes[random.choice(_NUMBERS)] = any_float(random)
            case 1:
                changes[random.choice(_FLAGS)] = True
            case 2:
                changes[random.choice(_COUNTS)] = random.choice((0, 1, 2, 6, 10**9))
            case 3:
                changes |= {"armed": random.choice((True, False, None)), "in_air": random.choice((True, False, None))}
            case 4:
                changes["flight_mode"] = random.choice((OFFBOARD, "hold", "", None))
            case 5:
                flags = [random.random() < 0.5 for _ in range(3)]
                one = CameraHealth(any_float(random), any_float(random), *flags)
                changes["cameras"] = {} if random.random() < 0.1 else {"front": one, "back": one}
            case 6:
                changes |= {"armed": False, "in_air": False, "resume_asked": random.random() < 0.5}
            case 7:
                changes[random.choice(_SEEN)] = random.choice(("seen", None))
    return changes


TARGETS = (
    Target("networks", 1, _networks),
    Target("gate", 200, _gate),
    Target("supervisor", 500, _supervisor),
)
