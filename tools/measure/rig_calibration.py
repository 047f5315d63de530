"""A rig that is not as configured, flown by sight in the simulator: what calibration in flight finds of it, and when.

python -m tools.measure.rig_calibration
python -m tools.measure.rig_calibration config/fisheye_flight.yaml --drones 3 --cameras realistic
python -m tools.measure.rig_calibration --exact --mounting 0 --late 0 --focal 0
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from flockd.core.config import ScenarioConfig, load_scenario
from flockd.core.messages import CameraDeviation, FloatArray, PilotOutput, ReasonKind
from flockd.flight.geometry import RigCamera, build_rig, rotation_from_vector, vector_from_rotation
from flockd.onboard.recording import Recorder
from flockd.sim.swarm import fly
from flockd.sim.true_rigs import true_rigs

SHOWN_EVERY = 4
"""Of the estimates that outputs hold, one each five seconds."""


class Kept:
    """In a recorder's place: one drone's outputs."""

    def __init__(self) -> None:
        self.outputs: list[PilotOutput] = []

    def drain(self) -> None:
        """Nothing is behind."""

    def step(self, frames: object, state: object, output: PilotOutput, *_: object) -> None:
        """Keeps the output."""
        self.outputs.append(output)


def main() -> None:
    """Flies and prints."""
    args = _arguments()
    scenario = _scenario(args)
    kept = [Kept() for _ in scenario.vehicles]
    began_s = time.monotonic()
    swap = frozenset({"flow", "depth"}) if args.exact else frozenset()
    fly(scenario, swap=swap, recorders=cast("Sequence[Recorder]", kept), processes=args.processes, pictured=False)
    flown = f"{scenario.scenario}, {len(kept)} drones, {scenario.duration_s:g} s"
    off = f"mountings {args.mounting:g} degrees, times {1e3 * args.late:g} ms, focal lengths {100 * args.focal:g} % off"
    print(f"{flown}, flown in {time.monotonic() - began_s:.0f} s: {off}")
    print("found less true:          roll, pitch, yaw in degrees    together      time, ms   focal length, %")
    configured, last = build_rig(scenario.drone.rig), []
    for drone, (one, rig) in enumerate(zip(kept, true_rigs(scenario), strict=True), start=1):
        said = [output for output in one.outputs if output.rig]
        began_s = one.outputs[0].time_s
        for number, output in enumerate(said):
            for found in output.rig:
                found_off = _off(found, rig.cameras[found.camera], configured.cameras[found.camera], args.late)
                if number == len(said) - 1:
                    last.append(found_off)
                if number % SHOWN_EVERY == SHOWN_EVERY - 1 or number == len(said) - 1:
                    at = f"drone{drone} {found.camera:6} {output.time_s - began_s:4.0f} s "
                    print(at + _text(found_off, found))
        for reason, since_s in _warnings(one.outputs).items():
            print(f"drone{drone} {since_s:6.1f} s: {reason}")
    turn_deg, time_ms, focal = (np.array(part) for part in zip(*last, strict=True))
    print(
        f"\nat the end, worst of {len(last)} cameras: {np.linalg.norm(turn_deg, axis=1).max():.2f} degrees, "
        f"{np.abs(time_ms).max():.1f} ms, {np.abs(focal).max():.2f} %"
    )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", nargs="?", type=Path, default=Path("config/paper_flight.yaml"))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--drones", type=int, default=2, help="the first so many of the scenario's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mounting", type=float, default=2.0, help="degrees")
    parser.add_argument("--late", type=float, default=0.03, help="seconds that images are older than they say")
    parser.add_argument("--focal", type=float, default=0.02, help="share")
    parser.add_argument("--moved", type=float, default=0.02, help="metres that a camera sits elsewhere")
    parser.add_argument("--cameras", choices=("ideal", "realistic"), default="ideal", help="beside that")
    parser.add_argument("--gusts", type=float, default=0.0, help="standard deviation, m/s")
    parser.add_argument("--exact", action="store_true", help="with true flow and depth, of pinholes")
    parser.add_argument("--processes", type=int, default=1)
    return parser.parse_args()


def _scenario(args: argparse.Namespace) -> ScenarioConfig:
    overrides: dict[str, Any] = {
        "duration_s": args.seconds,
        "seed": args.seed,
        "vehicle.gust_m_s": args.gusts,
        "cameras.preset": args.cameras,
        "cameras.timing.delay_s": args.late,
        "cameras.rig.mounting_deg": args.mounting,
        "cameras.rig.mounting_m": args.moved,
        "cameras.rig.focal": args.focal,
    }
    scenario = load_scenario(args.scenario, overrides)
    return scenario.model_copy(update={"vehicles": scenario.vehicles[: args.drones]})


def _off(
    found: CameraDeviation, true: RigCamera, configured: RigCamera, late_s: float
) -> tuple[FloatArray, float, float]:
    """Degrees (3,), milliseconds and per cent that what was found differs from what is true."""
    turn = true.T_body_camera.rotation @ configured.T_body_camera.rotation.T
    focal = true.camera.focal_px / configured.camera.focal_px
    off = vector_from_rotation(rotation_from_vector(found.turn) @ turn.T)
    return np.degrees(off), 1e3 * (found.time_offset_s + late_s), 100.0 * (found.focal_scale / focal - 1.0)


def _text(off: tuple[FloatArray, float, float], found: CameraDeviation) -> str:
    turn_deg, time_ms, focal = off
    sigma = np.sqrt(np.diag(found.covariance))
    axes = "  ".join(f"{a:5.2f}+-{math.degrees(s):4.2f}" for a, s in zip(turn_deg, sigma[:3], strict=True))
    size = np.linalg.norm(turn_deg)
    return f"{axes}   {size:5.2f}   {time_ms:5.1f}+-{1e3 * sigma[3]:4.1f}   {focal:5.2f}+-{100 * sigma[4]:4.2f}"


def _warnings(outputs: Sequence[PilotOutput]) -> dict[str, float]:
    """When each warning of the rig first came, seconds."""
    first: dict[str, float] = {}
    for output in outputs:
        for reason in output.reasons:
            if reason.kind is ReasonKind.RIG:
                first.setdefault(reason.text, output.time_s - outputs[0].time_s)
    return first


if __name__ == "__main__":
    main()
