"""Show where the error of neighbours' ranges comes from: the view of the drone, what is behind it, its contrast.

    python -m tools.measure.study_range_errors DATA [--pairs 200] [--models FOLDER] [--float] [--json]

DATA is a folder of tools.training.render_training_data. Only drones that are whole in the image, found, and within 10
m count.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from flockd.core.choices import ROLES
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.messages import Frame, FrameSet, VehicleState
from flockd.flight.geometry import Rig
from flockd.flight.perception import Networks, OnnxNetworks, Perception
from tools.measure.evaluation.on_pairs import Drone, Findings, compare_drones
from tools.training.dataset import R_BODY_CAMERA, PairSet, open_pairs, rig_camera

MAX_RANGE_M = 10.0
LOW_CONTRAST, HIGH_CONTRAST = 25.0, 50.0
"""Grey levels."""
Condition = Callable[[Drone], bool]
BACKGROUNDS: dict[str, Condition] = {
    "sky": lambda drone: drone.sky_share > 0.8,
    "ground, trees, houses": lambda drone: drone.sky_share < 0.2,
}
VIEWS: dict[str, Condition] = {
    "from above": lambda drone: drone.below_deg < -5.0,
    "level": lambda drone: abs(drone.below_deg) <= 5.0,
    "from below": lambda drone: drone.below_deg > 5.0,
}
CONTRASTS: dict[str, Condition] = {
    f"under {LOW_CONTRAST:g}": lambda drone: drone.contrast < LOW_CONTRAST,
    f"{LOW_CONTRAST:g} to {HIGH_CONTRAST:g}": lambda drone: LOW_CONTRAST <= drone.contrast < HIGH_CONTRAST,
    f"{HIGH_CONTRAST:g} and more": lambda drone: drone.contrast >= HIGH_CONTRAST,
}
ANY: dict[str, Condition] = {"any": lambda _: True}


def main() -> None:
    """Evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of tools.training.render_training_data")
    parser.add_argument("--models", type=Path, default=data_path("models"))
    parser.add_argument("--pairs", type=int, default=200, help="at most so many, evenly spread")
    parser.add_argument("--float", action="store_true", help="the float networks, not their 8-bit twins")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    config = PerceptionConfig(threads=1, flow="dis")
    if arguments.float:
        config = config.model_copy(
            update={role: getattr(config, role).removesuffix("_int8") for role in ROLES if role != "flow"}
        )
    found = findings(open_pairs(arguments.data), OnnxNetworks(config, arguments.models), arguments.pairs)
    drones = [drone for drone in found.drones if drone.found and drone.whole and drone.range_m < MAX_RANGE_M]
    rows = table_of(drones)
    if arguments.json:
        print(json.dumps(rows, indent=1))
        return
    table = Table("background", "view", "contrast, grey levels", "drones", "median %", "p95 %")
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    Console(width=110).print(table)


def findings(pairs: PairSet, networks: Networks, count: int) -> Findings:
    """The pipeline on the first image of so many pairs, with the exact height."""
    found = Findings()
    indices = np.unique(np.linspace(0, pairs.count - 1, min(count, pairs.count)).astype(int)).tolist()
    for index in track(indices, "images", console=Console(stderr=True)):
        rig = Rig({"camera": rig_camera(float(pairs["focal"][index]))})
        R_ned_camera = np.asarray(pairs["R_ned_camera"][index, 0], np.float64)
        vehicle = VehicleState(0.0, R_ned_camera @ R_BODY_CAMERA.T, float(pairs["height"][index, 0]))
        frames = FrameSet(0.0, {"camera": Frame("camera", np.asarray(pairs["image"][index][0]), 0.0, 0)})
        view = Perception(rig, networks, PerceptionConfig(scale="height")).observe(frames, vehicle)
        depth, ids = np.asarray(pairs["depth"][index][0], np.float32), np.asarray(pairs["ids"][index][0])
        compare_drones(view.detections, pairs, index, depth, ids, found)
    return found


def table_of(drones: list[Drone]) -> list[dict[str, object]]:
    """One row for each background and view, and for each background and contrast."""
    rows: list[dict[str, object]] = []
    for views, contrasts in ((VIEWS | ANY, ANY), (ANY, CONTRASTS)):
        for background, is_before in (BACKGROUNDS | ANY).items():
            for view, is_seen in views.items():
                for contrast, stands_out in contrasts.items():
                    errors = [abs(d.error) for d in drones if is_before(d) and is_seen(d) and stands_out(d)]
                    figures = {
                        name: round(100 * float(np.quantile(errors, q)), 2) if errors else None
                        for name, q in (("median", 0.5), ("p95", 0.95))
                    }
                    named = {"background": background, "view": view, "contrast": contrast}
                    rows.append({**named, "drones": len(errors), **figures})
    return rows


if __name__ == "__main__":
    main()
