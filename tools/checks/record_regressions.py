"""Make the four short recordings that the fast tests replay, and what is expected of them.

    python -m tools.checks.record_regressions [--out tests/review/replay] [--only references | FLIGHT]

- ``normal``: three drones on their way.
- ``crossing``: five drones fly through one another's images, 1 to 4 m away.
- ``fisheye``: as ``normal``, with the fisheyes of `config/quadrotor.yaml`, as bad as real ones.
- ``faults``: a camera lost, a black image, a torn one, a time stamp twice, one that goes back, a second of nothing.

Images are a quarter of the real size, but for the two cameras and six steps of ``fisheye``, and JPEG, so that a
recording is well under a megabyte. After a change that is meant to change outputs (new networks, say), `--only
references` writes the expectations again from the same recordings.
They are made with the networks in 32-bit floats, in place of those in 8 bits that the recordings were flown with: with
and without VNNI instructions, processors compute the latter differently.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from flockd.cli import main as flockd
from flockd.core.config import DroneConfig
from flockd.core.config.recording import RecordingConfig
from flockd.core.config.rig import CameraConfig
from flockd.core.data import data_path
from flockd.core.messages import Frame, FrameSet, MissionOrder, PilotOutput, UInt8Array, VehicleState
from flockd.flight.inference.hashes import model_hashes
from flockd.flight.pilot import FlockPilot
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.reader import Recording
from flockd.onboard.recording.truth import Truth
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import ScenarioConfig, StartConfig, load_scenario

Step = tuple[FrameSet, VehicleState]
Starts = Mapping[tuple[float, float, float], tuple[float, float]]
"""Velocity (north, east) in m/s of the drone at a place (north, east, down) in metres; the first drone is recorded."""
Change = Callable[[UInt8Array], UInt8Array]
STEPS, FISHEYE_STEPS = 10, 6
BAROMETER = {"drone.perception.height": "barometer"}
DRONE = "drone1"
NORMAL: Starts = {(0.0, 0.0, -3.0): (1.0, 0.0), (2.5, 1.2, -3.2): (1.0, 0.0), (-0.6, -2.8, -2.8): (1.0, 0.0)}
CROSSING: Starts = {
    (0.0, 0.0, -3.0): (0.5, 0.0),
    (1.6, -1.6, -3.1): (0.0, 1.0),
    (3.2, 1.8, -2.9): (0.0, -1.0),
    (-1.8, 1.2, -3.2): (1.0, -0.6),
    (0.3, 2.6, -3.0): (0.2, -1.0),
}


def main() -> None:
    """Make recordings and references."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("tests/review/replay"))
    flights: Mapping[str, Callable[[], tuple[DroneConfig, list[Step]]]] = {
        "normal": lambda: flown(_scenario(NORMAL, seed=21)),
        "crossing": lambda: flown(_scenario(CROSSING, seed=25)),
        "faults": lambda: with_faults(*flown(_scenario(NORMAL, seed=23))),
        "fisheye": lambda: flown(_fisheyes(NORMAL, seed=29)),
    }
    only = "leave the recordings as they are, or make that of one flight"
    parser.add_argument("--only", choices=["references", *flights], help=only)
    arguments = parser.parse_args()
    for name, make in flights.items():
        recording, reference = arguments.out / f"{name}.mcap", arguments.out / f"{name}.expected"
        if arguments.only not in (None, "references", name):
            continue
        if arguments.only != "references":
            record(recording, *make())
        with tempfile.TemporaryDirectory() as folder:
            config = with_float_networks(recording, Path(folder) / "drone.yaml")
            update = ["--config", str(config), "--reference", str(reference), "--update-reference"]
            if flockd(["replay", str(recording), *update]):
                raise SystemExit(f"{recording}: could not be replayed")
        print(f"{recording}: {recording.stat().st_size / 1e6:.2f} MB, {reference.stat().st_size / 1e3:.0f} kB expected")


def with_float_networks(recording: Path, target: Path) -> Path:
    """Writes the recording's configuration to the target, each 8-bit network replaced by the one it was made from."""
    document = json.loads(Recording(recording).config.model_dump_json())
    document["perception"] = {
        key: value.removesuffix("_int8") if isinstance(value, str) else value
        for key, value in document["perception"].items()
    }
    target.write_text(yaml.safe_dump(document), encoding="utf-8")
    return target


def flown(scenario: ScenarioConfig) -> tuple[DroneConfig, list[Step]]:
    """A flight in the simulator: what the first drone's pilot was given."""
    keeper, count = _Keeper(), len(scenario.vehicles)
    fly(scenario, recorders=[keeper] * count)  # type: ignore[list-item]
    return scenario.drone, keeper.steps[::count]


class _Keeper:
    """In a recorder's place: keeps every step of every drone in turn."""

    def __init__(self) -> None:
        self.steps: list[Step] = []

    def drain(self) -> None:
        """All is kept at once."""

    def step(
        self, frames: FrameSet, vehicle: VehicleState, output: PilotOutput, truth: Truth | None,
        order: MissionOrder | None,
    ) -> None:  # fmt: skip
        """Keep what went in."""
        self.steps.append((frames, vehicle))


def _scenario(starts: Starts, seed: int) -> ScenarioConfig:
    """The paper's flight, shorter, from other places, with cameras of half the width and height."""
    paper = load_scenario(data_path("config") / "paper_flight.yaml", BAROMETER)
    cameras = []
    for camera in paper.drone.rig.cameras:
        width, height = camera.size_px
        halved = {name: getattr(camera.intrinsics, name) / 2 for name in ("fx", "fy", "cx", "cy")}
        intrinsics = camera.intrinsics.model_copy(update=halved)
        cameras.append(camera.model_copy(update={"size_px": (width // 2, height // 2), "intrinsics": intrinsics}))
    return _with(paper, cameras, starts, seed, STEPS)


def _fisheyes(starts: Starts, seed: int) -> ScenarioConfig:
    """The same with two fisheyes of full size, as bad as real ones: in halved images they leave little of a drone."""
    flight = load_scenario(data_path("config") / "fisheye_flight.yaml", BAROMETER)
    cameras = [camera for camera in flight.drone.rig.cameras if camera.name in ("front", "left")]
    return _with(flight, cameras, starts, seed, FISHEYE_STEPS)


def _with(
    flight: ScenarioConfig, cameras: Sequence[CameraConfig], starts: Starts, seed: int, steps: int
) -> ScenarioConfig:
    drone = flight.drone.model_copy(update={"rig": flight.drone.rig.model_copy(update={"cameras": tuple(cameras)})})
    vehicles = tuple(StartConfig(position_m=p, velocity_m_s=v) for p, v in starts.items())
    duration_s = steps * drone.step_s
    return flight.model_copy(update={"drone": drone, "vehicles": vehicles, "seed": seed, "duration_s": duration_s})


def with_faults(drone: DroneConfig, steps: Sequence[Step]) -> tuple[DroneConfig, list[Step]]:
    """The same flight with something wrong with every step of its second half."""
    changed = list(steps)
    changed[4] = _with_images(changed[4], {"right": None})
    changed[5] = _with_images(changed[5], {"front": _black})
    changed[6] = _with_images(changed[6], {"left": _torn})
    changed[7] = _at(changed[7], changed[6][0].time_s)
    changed[8] = _at(changed[8], changed[6][0].time_s - 0.25)
    changed[9] = _at(changed[9], changed[9][0].time_s + 1.0)
    return drone, changed


def _with_images(step: Step, changes: Mapping[str, Change | None]) -> Step:
    frames: dict[str, Frame] = {}
    for name, frame in step[0].frames.items():
        change = changes.get(name, _as_it_is)
        if change is not None:
            frames[name] = replace(frame, image=change(frame.image))
    return replace(step[0], frames=frames), step[1]


def _as_it_is(image: UInt8Array) -> UInt8Array:
    return image


def _black(image: UInt8Array) -> UInt8Array:
    return np.zeros_like(image)


def _torn(image: UInt8Array) -> UInt8Array:
    """Its lower half is grey, as of a JPEG that ends early."""
    torn = image.copy()
    torn[len(torn) // 2 :] = 128
    return torn


def _at(step: Step, time_s: float) -> Step:
    frames = {name: replace(frame, time_s=time_s) for name, frame in step[0].frames.items()}
    return replace(step[0], time_s=time_s, frames=frames), replace(step[1], time_s=time_s)


def record(path: Path, config: DroneConfig, steps: Sequence[Step]) -> None:
    """Write the steps as a flight of ``DRONE``."""
    pilot = FlockPilot(config)
    settings = RecordingConfig(images="jpeg", jpeg_quality=85)
    with Recorder(
        path, drone=DRONE, config=config, settings=settings, models=model_hashes(config.perception)
    ) as recorder:
        for frames, vehicle in steps:
            recorder.step(frames, vehicle, pilot.step(frames, vehicle))
            recorder.drain()


if __name__ == "__main__":
    main()
