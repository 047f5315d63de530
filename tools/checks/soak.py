"""Run a whole daemon for long and see what grows: a real `flockd run`, a fake autopilot, rendered frames.

python -m tools.checks.soak --minutes 60

Prints for memory, file descriptors, threads, latency and what waits or is lost: how much it grew in the first tenth of
the run, which is the warm-up. Then the mean of the next and of the last tenth, and the slope over the rest with its 95
% confidence interval. The slope is a straight line through the means of 20 stretches of the run after the warm-up, so
that neighbouring samples, which are alike, do not count as independent. Exit code 1 if something grows by more than its
allowance, all of the interval above it.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from flockd.core.config import DroneConfig, load_drone
from flockd.core.data import data_path
from flockd.fleet.watcher import FleetWatcher
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.scenario import load_scenario
from flockd.sim.sitl.daemons import Daemons
from flockd.sim.sitl.frame_server import FrameServer
from flockd.sim.sitl.ground_station import Poses
from flockd.sim.sitl.processes import free_endpoint, free_port

SHRINK = 4
"""Factor on the simulator's front camera, the only one: 120 x 160 pixels, so that much else fits beside it."""
HEIGHT_M = 4.0
NEIGHBOUR_M = 2.0
"""How far away the other drone is. In images as small as this it is detected up to a metre; a daemon that really flies
would keep away from it there, for ever, so that it flies as if alone."""
STRETCHES = 20
SAMPLE_S = 2.0
PATIENCE_S = 600.0
"""For the daemon to become ready: a busy computer compiles the renderer for minutes."""
ALLOWED = {
    "memory, MB": 0.03,
    "own memory, MB": 0.03,
    "descriptors": 0.02,
    "threads": 0.02,
}
"""Growth over the run, as a share of the mean, that is noise; of any other quantity, none is judged."""


def slope_of(name: str, values: Sequence[float]) -> dict[str, float]:
    """How a quantity went, by samples evenly spread over a run, at least 40.

    `warm_up`: growth in the first tenth, from its first samples to its last; `first`, `last`: means of the second and
    of the last tenth; `slope` over the run without its first tenth, in the quantity's unit, and the ends `low` and
    `high` of its 95 % confidence interval; `grows`: 1 if it is more than allowed.
    """
    samples = np.asarray(values, float)
    tenth = max(len(samples) // 10, 1)
    means = np.array([stretch.mean() for stretch in np.array_split(samples[tenth:], STRETCHES)])
    line, edge = stats.linregress(np.linspace(0.0, 1.0, STRETCHES), means), max(tenth // 10, 1)
    margin = float(np.nan_to_num(stats.t.ppf(0.975, STRETCHES - 2) * line.stderr))  # NaN: the same all the time
    allowed = ALLOWED.get(name, np.inf) * abs(float(samples.mean()))
    return {
        "warm_up": samples[tenth - edge : tenth].mean() - samples[:edge].mean(),
        "first": samples[tenth : 2 * tenth].mean(), "last": samples[-tenth:].mean(), "slope": line.slope,
        "low": line.slope - margin, "high": line.slope + margin, "grows": float(line.slope - margin > allowed),
    }  # fmt: skip


def of_the_unit() -> dict[str, str]:
    """The environment that systemd gives the daemon."""
    lines = (data_path("systemd") / "flockd.service").read_text(encoding="utf-8").splitlines()
    pairs = " ".join(line.removeprefix("Environment=") for line in lines if line.startswith("Environment="))
    return dict(pair.split("=", 1) for pair in pairs.split())


def process_facts(pid: int) -> dict[str, float]:
    """What Linux counts of a process. Raises OSError when it has ended."""
    folder = Path(f"/proc/{pid}")
    lines = (line.split() for line in (folder / "status").read_text(encoding="ascii").splitlines())
    known = {words[0].rstrip(":"): int(words[1]) / 1024 for words in lines if words[-1] == "kB"}
    return {
        "memory, MB": known["VmRSS"],
        "own memory, MB": known["RssAnon"],  # without files' pages, as of libraries first used late
        "descriptors": float(len(list((folder / "fd").iterdir()))),
        "threads": float(len(list((folder / "task").iterdir()))),
    }


def small(config: DroneConfig) -> DroneConfig:
    """With a front camera of a quarter of the width and height, and no other."""
    cameras = []
    for camera in config.rig.cameras[:1]:
        width, height = camera.size_px
        shrunk = {name: getattr(camera.intrinsics, name) / SHRINK for name in ("fx", "fy", "cx", "cy")}
        intrinsics = camera.intrinsics.model_copy(update=shrunk)
        size_px = (width // SHRINK, height // SHRINK)
        cameras.append(camera.model_copy(update={"size_px": size_px, "intrinsics": intrinsics}))
    return config.model_copy(update={"rig": config.rig.model_copy(update={"cameras": tuple(cameras)})})


def _add(samples: dict[str, array[float]], facts: Mapping[str, float]) -> None:
    for name, value in facts.items():
        samples.setdefault(name, array("d")).append(value)  # small


def soak_daemon(minutes: float) -> dict[str, array[float]]:
    """Samples of each quantity, from the moment in which the daemon is ready and flies."""
    port, frames_at, telemetry_at = free_port(), free_endpoint(), free_endpoint()
    config = daemon_config(port, frames_at, telemetry_at)
    paper = load_scenario(data_path("config") / "paper_flight.yaml", {"seed": 5})
    world = paper.model_copy(update={"drone": config, "vehicles": paper.vehicles[:2]})
    with tempfile.TemporaryDirectory() as name, FakeAutopilot(port, height_m=HEIGHT_M) as autopilot:

        def poses() -> Poses:
            """The drone, and a neighbour north of it that does as it does."""
            state = autopilot.state
            places = np.stack([state.position, state.position + np.array([NEIGHBOUR_M, 0.0, 0.0])])
            return Poses(time.monotonic(), places, np.array([state.R_ned_body] * 2), np.array([state.velocity] * 2))

        folder = Path(name)
        with (
            FrameServer(
                CameraSimulator(world), [config.name], endpoint=frames_at, rate_hz=2.0, poses=poses,
                clock=time.monotonic, speed_factor=1.0,
            ) as server,
            Daemons([config], folder=folder, recordings=folder, environment={**os.environ, **of_the_unit()}) as daemons,
        ):  # fmt: skip
            server.start()
            daemons.start()
            _wait_for(daemons, server)
            with FleetWatcher(None, listen=(), connect=(telemetry_at,)) as watcher:
                return _watched(daemons, autopilot, watcher, 60.0 * minutes)


def daemon_config(port: int, frames_at: str, telemetry_at: str) -> DroneConfig:
    """That of PX4 SITL with the ports that are free here and a small camera, which flies its circle for ever."""
    config = small(load_drone(data_path("config") / "px4_sitl.yaml"))
    assert config.source is not None
    assert config.autopilot is not None
    shared_memory = config.source.shared_memory.model_copy(update={"connect": (frames_at,)})
    return config.model_copy(
        update={
            "source": config.source.model_copy(update={"shared_memory": shared_memory}),
            "autopilot": config.autopilot.model_copy(update={"address": f"udpin://127.0.0.1:{port}"}),
            "telemetry": config.telemetry.model_copy(update={"listen": (telemetry_at,), "connect": ()}),
            "mission": config.mission.model_copy(update={"circle_until_s": 1e9}),
            "safety": config.safety.model_copy(update={"alone_s": None}),
        }
    )


def _wait_for(daemons: Daemons, server: FrameServer) -> None:
    program, until_s = daemons.programs()[0], time.monotonic() + PATIENCE_S
    while not daemons.is_ready(0):
        server.frames()  # raises what ended its thread
        if program.ended is not None or time.monotonic() > until_s:
            raise SystemExit(f"soak: the daemon did not become ready: {program.last_output()}")
        time.sleep(0.1)


def _watched(
    daemons: Daemons, autopilot: FakeAutopilot, watcher: FleetWatcher, seconds: float
) -> dict[str, array[float]]:
    samples: dict[str, array[float]] = {}
    program, until_s = daemons.programs()[0], time.monotonic() + seconds
    resumed = 0
    while time.monotonic() < until_s:
        if autopilot.mode != "OFFBOARD":  # the first time; and again when this computer was too busy to fly
            resumed += _fly(autopilot, watcher)
        time.sleep(SAMPLE_S)
        if program.ended is not None:
            raise SystemExit(f"soak: the daemon has ended: {program.last_output()}")
        _add(samples, {**process_facts(program.process.pid), **_told(watcher), "offboard selected": float(resumed)})
    return samples


def _fly(autopilot: FakeAutopilot, watcher: FleetWatcher) -> bool:
    """As people do it: in Hold until the drone is ready, and offboard then; whether that was selected.

    With the switch left at offboard the autopilot stays in its failsafe, into which flockd sends nothing.
    """
    drones = watcher.drones()
    flight = (drones[0].message("flight", time.monotonic()) if drones else None) or {}
    ready = flight.get("state") == "ready" and flight.get("flight_mode") == "hold"
    autopilot.pilot_selects("OFFBOARD" if ready else "LOITER")
    if drones and not ready:
        watcher.ask(f"{drones[0].fleet}/{drones[0].drone}", "resume", "soak")
    return ready


def _told(watcher: FleetWatcher) -> Mapping[str, float]:
    """What the daemon publishes of itself; NaN while it has not yet."""
    drones, now_s = watcher.drones(), time.monotonic()
    message = drones[0].message if drones else lambda topic, at_s: None
    computer, flight = (message(topic, now_s) or {} for topic in ("computer", "flight"))
    return {
        "load": float(computer.get("load", np.nan)),
        "loop lag, s": float(computer.get("loop_lag_s", np.nan)),
        "steps": float(computer.get("steps", np.nan)),
        "steps failed": float(computer.get("steps_failed", np.nan)),
        "messages lost": float(computer.get("messages_lost", np.nan)),
        "setpoints missed": float(flight.get("setpoints_missed", np.nan)),
    }


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="(default: 60)")
    minutes = parser.parse_args().minutes
    samples = soak_daemon(minutes)
    slopes = {name: slope_of(name, _filled(values)) for name, values in samples.items()}
    print(f"{minutes:g} minutes of a daemon, {len(next(iter(samples.values())))} samples")
    print(f"{'':20}{'warm-up':>10}{'first':>10}{'last':>10}{'growth after the warm-up, 95 %':>34}")
    for name, one in slopes.items():
        verdict = "  GROWS" if one["grows"] else ""
        interval = f"{one['slope']:+.3f} ({one['low']:+.3f} to {one['high']:+.3f})"
        print(f"{name:20}{one['warm_up']:+10.2f}{one['first']:10.2f}{one['last']:10.2f}{interval:>34}{verdict}")
    return 1 if any(one["grows"] for one in slopes.values()) else 0


def _filled(values: Sequence[float]) -> list[float]:
    """With the last known value where one is missing; zeros before the first."""
    known, filled = 0.0, []
    for value in values:
        known = value if np.isfinite(value) else known
        filled.append(known)
    return filled


if __name__ == "__main__":
    sys.exit(main())
