"""A made-up flight: small pictures, numbers hard to write down, and a pilot that uses all of what it is given."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.drone import RecordingConfig
from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, IntrinsicsConfig, RigConfig
from flockd.core.messages import (
    EgoMotion,
    Frame,
    FrameSet,
    LearnedSize,
    MissionOrder,
    Neighbour,
    PilotOutput,
    RangeReading,
    VehicleState,
    Wanted,
)
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.mcap_file import Damage, McapFile, Note, Record, read_records
from tests.make import filled

WIDTH, HEIGHT = 160, 120
MODELS = {"flow": "ab" * 32}
LEARNED = LearnedSize(0.43, 1 / 11)


def drone_config() -> DroneConfig:
    lens = IntrinsicsConfig(fx=80.0, fy=81.0, cx=79.5, cy=60.25)
    places = {
        "front": ExtrinsicsConfig(position_m=(0.1, 0.0, -0.02), yaw_deg=10.0, pitch_deg=-20.0, roll_deg=5.0),
        "left": ExtrinsicsConfig(yaw_deg=270.0),
    }
    cameras = tuple(
        CameraConfig(name=name, size_px=(WIDTH, HEIGHT), intrinsics=lens, extrinsics=place)
        for name, place in places.items()
    )
    return DroneConfig(rig=RigConfig(cameras=cameras))


class MadeUpPilot:
    """Its outputs hang on every pixel, every number of the vehicle's state, and all that came before."""

    def __init__(
        self,
        config: DroneConfig,
        networks: object = None,
        stopwatch: Callable[[], float] | None = None,
        learned: LearnedSize | None = None,
    ) -> None:
        self._memory = 0.1 if learned is None else learned.size_m + learned.sigma
        self.gain = config.flocking.cohesion

    def step(self, frames: FrameSet, vehicle: VehicleState, *, order: MissionOrder | None = None) -> PilotOutput:
        seen = sum(float((frame.image * np.arange(1.0, 4.0)).sum()) for frame in frames.frames.values()) / 1e6
        felt = float(vehicle.R_ned_body.sum()) + vehicle.height_m / 3.0
        felt += 0.0 if vehicle.velocity_ned is None else float(vehicle.velocity_ned.sum())
        felt += 0.0 if vehicle.ground_range is None else vehicle.ground_range.range_m + vehicle.ground_range.time_s / 7
        self._memory = math.sin(self._memory + seen + felt + self.gain)
        m = self._memory
        whole: PilotOutput = filled(PilotOutput, m)
        return replace(
            whole,
            time_s=frames.time_s,
            ego_motion=replace(filled(EgoMotion, m), translation=np.array([m, 1e-310, -0.0])),
            velocity=np.array([m, 1 / 3, math.nan]),
            neighbours=(replace(filled(Neighbour, m), velocity_sigma_m_s=math.inf),),
            command=Wanted(np.array([m, -m]), np.array([0.1 * m, 0.2]), m),
        )


def inputs(steps: int, levels: int = 256) -> Iterator[tuple[FrameSet, VehicleState]]:
    """Frame sets and vehicle states at times that no decimal fraction hits; pictures of few levels compress well."""
    rng = np.random.default_rng(0)
    for step in range(steps):
        time_s = 1000.0 + 0.1 * step + 1 / 3e6
        frames = {
            name: Frame(name, rng.integers(0, levels, (HEIGHT, WIDTH, 3), dtype=np.uint8), time_s - 1e-3 / 7, 10 + step)
            for name in ("front", "left")
        }
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        velocity = None if step == 1 else rng.normal(size=3)
        reading = None if step % 3 == 1 else RangeReading(time_s - 0.01, 4.0 + step / 3, min_m=0.2, quality=0.7 / 9)
        height_m = float(rng.normal(5.0))
        yield FrameSet(time_s, frames), VehicleState(time_s, turn, height_m, velocity, ground_range=reading)


def rewritten(source: Path, target: Path, change: Callable[[Record], Record]) -> Path:
    """A copy of a recording with changed records, all checksums right."""
    with McapFile(target) as file:
        for found in read_records(source):
            assert not isinstance(found, Damage)
            file.write(change(found))
    return target


def with_facts(source: Path, target: Path, **facts: str) -> Path:
    """A copy of a recording all of whose notes say this too."""
    return rewritten(
        source, target, lambda one: replace(one, facts={**one.facts, **facts}) if isinstance(one, Note) else one
    )


def record(
    path: Path,
    flown: int | Iterable[tuple[FrameSet, VehicleState]] = 10,
    settings: RecordingConfig | None = None,
    learned: LearnedSize | None = LEARNED,
    told: list[str] | None = None,
) -> list[PilotOutput]:
    """Records a made-up flight, of so many steps or of these inputs, and gives what its pilot said.

    ``told`` gets the recorder's events; without it, the recording has to be whole.
    """
    config, outputs, events = drone_config(), list[PilotOutput](), list[str]() if told is None else told
    pilot = MadeUpPilot(config, learned=learned)
    with Recorder(
        path, drone="drone1", config=config, settings=settings, models=MODELS, learned=learned, on_event=events.append
    ) as recorder:
        for frames, vehicle in inputs(flown) if isinstance(flown, int) else flown:
            outputs.append(pilot.step(frames, vehicle))
            recorder.drain()
            recorder.step(frames, vehicle, outputs[-1])
    assert told is not None or recorder.failure is None
    return outputs
