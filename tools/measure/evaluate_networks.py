"""Measure the shipped networks on rendered worlds that they never saw, and print one table.

python -m tools.training.render_training_data DATA/test   --split test --worlds 25 --pairs 12
python -m tools.training.render_training_data DATA/unseen --split test --worlds 25 --pairs 12 --families unseen
python -m tools.measure.evaluate_networks --data DATA/test --unseen DATA/unseen [--json]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from flockd.core.choices import ROLES
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.messages import Frame
from flockd.flight.geometry import PinholeCamera, RigidTransform
from flockd.flight.perception import Crop, OnnxNetworks
from tools.measure.on_pairs import HEIGHT_SIGMAS_M, MASK_WITHIN_M, Findings, look_at_pairs
from tools.training.dataset import WIDTH, PairSet, open_pairs, rig_camera

RANGES_M = ((1.5, 5.0), (5.0, 10.0), (10.0, 20.0))
IMAGES_TIMED = 60
CROPS_OF_A_DRONE = (1, 1, 1)
"""As many as it takes one after another, mostly: see ``flockd.flight.perception.detection.refinement``."""

WITH: dict[str | None, str] = {
    None: "RGB alone",
    **{given: f"attitude, height by {given} ({sigma:g} m)" for given, sigma in HEIGHT_SIGMAS_M.items()},
}
"""What the scale of depth comes from."""


@dataclass(frozen=True)
class Row:
    """One figure."""

    name: str
    value: float
    unit: str
    count: int
    """What it was measured on."""

    def __str__(self) -> str:
        return f"{self.name:88s} {self.value:10.4g} {self.unit:3s} {self.count:8d}"


def main() -> None:
    """Evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of render_training_data.py")
    parser.add_argument("--unseen", type=Path, help="another one, with families that no network was trained on")
    parser.add_argument("--models", type=Path, default=data_path("models"))
    parser.add_argument("--pairs", type=int, default=10_000, help="of each folder at most this many")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--float", action="store_true", help="the float networks, not their 8-bit twins")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    config = PerceptionConfig(threads=arguments.threads)
    if arguments.float:
        config = config.model_copy(update={role: getattr(config, role).removesuffix("_int8") for role in ROLES})
    perception = OnnxNetworks(config, arguments.models)

    def findings(folder: Path) -> Findings:
        pairs = open_pairs(folder)
        indices = range(min(pairs.count, arguments.pairs))
        return look_at_pairs(pairs, perception, indices)

    rows = list(rows_of_pairs(findings(arguments.data)))
    if arguments.unseen is not None:
        rows += rows_of_unseen(findings(arguments.unseen))
    rows += rows_of_cost(perception, open_pairs(arguments.data), arguments.threads)
    files = list(arguments.models.glob("*.onnx"))
    rows.append(Row("all networks", sum(file.stat().st_size for file in files) / 1e6, "MB", len(files)))
    if arguments.json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
        return
    for row in rows:
        print(row)


def rows_of_pairs(found: Findings) -> Iterator[Row]:
    """Of drones, depth, masks and flow."""
    yield from _distances(found, "")
    whole = sum(drone.found and drone.whole for drone in found.drones)
    for sigmas in (1, 2):
        yield Row(f"distance errors inside {sigmas} sigma", 100 * found.inside(sigmas), "%", whole)
    for given, name in WITH.items():
        depth = found.depth[given]
        yield Row(f"background depth, relative error, {name}, median", 100 * float(np.median(depth)), "%", len(depth))
        of_pixels = np.concatenate(found.depth_pixels[given])
        what = f"background depth of a pixel, relative error, {name}, median"
        yield Row(what, 100 * float(np.median(of_pixels)), "%", len(of_pixels))
    yield Row(f"mask IoU, drones within {MASK_WITHIN_M:g} m, mean", float(np.mean(found.iou)), "", len(found.iou))
    for low, high, name in ((12, np.inf, "at least 12"), (6, 12, "6 to 12")):
        count = sum(low <= drone.width_px < high for drone in found.drones)
        yield Row(f"drones whose box is {name} px wide, found", 100 * found.found(low, high), "%", count)
        yield Row(f"drones whose box is {name} px wide, proposed", 100 * found.proposed(low, high), "%", count)
    yield Row("false drones in 500 images", 500 * found.false / found.images, "", found.images)
    for on_drones, where in ((False, "background"), (True, "drones")):
        for network, name in (("network", "flow"), ("dis", "OpenCV DIS medium")):
            errors = found.flow_errors(network, on_drones=on_drones)
            for kind, figure in (("median", np.median), ("mean", np.mean)):
                yield Row(f"{name} on {where}, end-point error, {kind}", float(figure(errors)), "px", len(errors))
    ours, of_dis = (
        np.concatenate([found.flow_errors(n, on_drones=d) for d in (False, True)]) for n in ("network", "dis")
    )
    yield Row(
        "flow, mean end-point error as a share of OpenCV DIS medium's",
        float(ours.mean() / of_dis.mean()),
        "",
        ours.size,
    )


def rows_of_unseen(found: Findings) -> list[Row]:
    """Distances of drones of families that no network was trained on."""
    return list(_distances(found, ", unseen families"))


def _distances(found: Findings, note: str) -> Iterator[Row]:
    parts = [(low, high, True) for low, high in RANGES_M] + [(0.0, 10.0, False)]
    figures: dict[str, Callable[..., float]] = {
        "median": lambda errors: np.median(np.abs(errors)),
        "p95": lambda errors: np.quantile(np.abs(errors), 0.95),
        "bias": np.median,
    }
    for low, high, whole in parts:
        errors = found.errors(low, high, whole=whole)
        what = f"whole, {low:g}-{high:g} m" if whole else f"cut or hidden, within {high:g} m"
        if len(errors):
            for name, figure in figures.items():
                yield Row(f"distance{note}, {what}, {name}", 100 * float(figure(errors)), "%", len(errors))


def rows_of_cost(perception: OnnxNetworks, pairs: PairSet, threads: int) -> Iterator[Row]:
    """Time of an image with up to four drones; their crops are cut beforehand."""
    camera = rig_camera(WIDTH / 2)
    side = perception.second_stage.crop_size if perception.second_stage else 0
    times = []
    for pair in range(min(pairs.count, IMAGES_TIMED)):
        image = np.asarray(pairs["image"][pair][0])
        pinhole = PinholeCamera(np.array([[60.0, 0, side / 2], [0, 60.0, side / 2], [0, 0, 1.0]]), (side, side))
        crop = Crop(np.ascontiguousarray(image[:side, :side]), pinhole, RigidTransform(np.eye(3), np.zeros(3)))
        begin = time.perf_counter()
        perception.scene(Frame("camera", image, 0.0, 0), camera, None)
        for crops in CROPS_OF_A_DRONE:
            perception.ranges([crop] * 4 * crops)
        times.append(time.perf_counter() - begin)
    name = f"depth, masks and four drones' distances of an image, {threads} threads"
    yield Row(name, 1e3 * float(np.median(times)), "ms", len(times))


if __name__ == "__main__":
    main()
