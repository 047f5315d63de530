"""Measure the shipped networks on rendered worlds that they never saw, and print one table.

python tools/render_training_data.py DATA/test --split test --worlds 25 --pairs 12
python tools/evaluate_networks.py --data DATA/test [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from flockd.config.parameters import PerceptionConfig
from flockd.data import data_path
from flockd.geometry import Rig
from flockd.messages import Frame, FrameSet, Sighting, VehicleState
from flockd.perception import UNSURE, DisFlow, Perception
from flockd.pilot.views import Observer
from flockd.sim.drone_models import drone_model
from tools.training.dataset import HEIGHT, R_BODY_CAMERA, WIDTH, PairSet, open_pairs, rig_camera
from tools.training.samples import SIZES_M

Array = NDArray[Any]
BAROMETER_SIGMA_M = 0.1
GATE = 0.3
"""A sighting is a drone's if it is nearer to it than this share of its range, or 0.5 m."""
WHOLE_HIDES = 0.02
"""A drone counts as whole when no more of its outline is hidden than this."""
RANGES_M = ((1.5, 5.0), (5.0, 10.0), (10.0, 20.0))


def main() -> None:
    """Evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of render_training_data.py")
    parser.add_argument("--models", type=Path, default=data_path("models"))
    parser.add_argument("--pairs", type=int, default=10_000, help="at most this many")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    pairs = open_pairs(arguments.data)
    perception = Perception(PerceptionConfig(threads=arguments.threads), arguments.models)
    result = evaluate(pairs, perception, range(min(pairs.count, arguments.pairs)))
    if arguments.json:
        print(json.dumps(result, indent=1))
        return
    for name, value in result.items():
        print(f"{name:58s} {value:10.4f}" if isinstance(value, float) else f"{name:58s} {value!s:>10s}")


def evaluate(pairs: PairSet, perception: Perception, indices: Iterable[int]) -> dict[str, float]:
    """Every figure by name; lengths in metres, shares as fractions, flow in full-size pixels."""
    rng = np.random.Generator(np.random.PCG64(0))
    dis = DisFlow()
    found = _Found()
    for index in indices:
        focal = float(pairs["focal"][index])
        rig = Rig({"camera": rig_camera(focal)})
        images = np.asarray(pairs["image"][index])
        R_ned_camera = np.asarray(pairs["R_ned_camera"][index, 0], np.float64)
        height = float(pairs["height"][index, 0]) + float(rng.normal(0, BAROMETER_SIGMA_M))
        frames = FrameSet(0.0, {"camera": Frame("camera", images[0], 0.0, 0)})
        vehicle = VehicleState(0.0, R_ned_camera @ R_BODY_CAMERA.T, height)
        depth, ids = np.asarray(pairs["depth"][index][0], np.float32), np.asarray(pairs["ids"][index][0])
        for name, with_height in (("height", True), ("rgb", False)):
            observer = Observer(rig, perception, height_fixes_scale=with_height)
            maps, _ = observer.scenes(frames, vehicle)
            found.depth[name].append(_depth_error(maps["camera"].depth[1::2, 1::2], depth, ids))
            if with_height:
                labels = maps["camera"].labels[1::2, 1::2]
                _mask((labels > 0) & (labels != UNSURE), ids, pairs, index, found)
                sightings = observer.view(frames, vehicle, maps, ()).sightings
                _distances(sightings, pairs, index, depth, ids, found)
        flow = np.asarray(pairs["flow"][index], np.float32)
        valid = np.asarray(pairs["flow_valid"][index])
        for name, guess in (("flow", perception.flow("camera", *images)), ("dis", dis.flow(*images))):
            error = np.linalg.norm(np.moveaxis(guess[1::2, 1::2], 2, 0) - flow, axis=0)
            found.flow[name].append(error[valid & (ids == 0)])
            found.flow_drone[name].append(error[valid & (ids > 0)])
    return found.figures()


class _Found:
    """What is gathered over all pairs."""

    def __init__(self) -> None:
        self.depth: dict[str, list[float]] = {"height": [], "rgb": []}
        self.flow: dict[str, list[Array]] = {"flow": [], "dis": []}
        self.flow_drone: dict[str, list[Array]] = {"flow": [], "dis": []}
        self.iou: list[float] = []
        self.drones: list[tuple[float, float, bool, bool, float, float]] = []
        self.false = 0
        self.images = 0

    def figures(self) -> dict[str, float]:
        out: dict[str, float] = {"images": float(self.images)}
        for name, errors in self.depth.items():
            out[f"background depth, absolute relative error, {name}, median"] = float(np.median(errors))
        out["mask IoU, drones within 10 m"] = float(np.mean(self.iou)) if self.iou else float("nan")
        d = np.array(self.drones, np.float64).reshape(-1, 6)
        range_m, width, whole, seen, error, sigma = d.T
        for low, high in RANGES_M:
            for part, name in ((whole > 0, "whole"), (whole == 0, "cut or hidden")):
                chosen = part & (seen > 0) & (range_m >= low) & (range_m < high)
                if chosen.any():
                    size = np.abs(error[chosen])
                    key = f"distance {low:g}-{high:g} m, {name}"
                    out[f"{key}, median"], out[f"{key}, p95"] = float(np.median(size)), float(np.quantile(size, 0.95))
                    out[f"{key}, bias"] = float(np.median(error[chosen]))
        known = (seen > 0) & (whole > 0)
        for k in (1, 2):
            inside = np.abs(error[known]) < k * sigma[known]
            out[f"distance errors inside {k} sigma"] = float(inside.mean()) if known.any() else float("nan")
        for low, high in ((6, 12), (12, 10_000)):
            chosen = (width >= low) & (width < high)
            out[f"drones {low}-{high} px wide, found"] = float(seen[chosen].mean()) if chosen.any() else float("nan")
        out["false drones per 500 images"] = 500.0 * self.false / max(self.images, 1)
        for where, errors_of in (("background", self.flow), ("drones", self.flow_drone)):
            for name, parts in errors_of.items():
                joined = np.concatenate(parts)
                out[f"{name} on {where}, px, median"] = float(np.median(joined))
                out[f"{name} on {where}, px, mean"] = float(np.mean(joined))
        return out


def _depth_error(guess: Array, true: Array, ids: Array) -> float:
    near = (ids == 0) & (true < 60.0)
    return float(np.mean(np.abs(guess[near] - true[near]) / true[near])) if near.any() else 0.0


def _mask(guess: Array, ids: Array, pairs: PairSet, index: int, found: _Found) -> None:
    """IoU of every drone within 10 m, over its box with a margin."""
    for drone in np.flatnonzero(pairs["drone_pixels"][index, 0] > 30):
        if np.linalg.norm(pairs["drone_centre"][index, 0, drone]) > 10.0:
            continue
        left, top, right, bottom = (pairs["drone_box"][index, 0, drone] / 2).astype(int)
        part = np.s_[max(0, top - 3) : bottom + 3, max(0, left - 3) : right + 3]
        other = (ids[part] > 0) & (ids[part] != drone + 1)
        mine, said = (ids[part] == drone + 1), guess[part] & ~other
        found.iou.append(float((mine & said).sum() / max((mine | said).sum(), 1)))


def _hidden_share(pairs: PairSet, index: int, drone: int, depth: Array, ids: Array) -> float:
    """How much of the drone's outline, as if a thread ran around it, something nearer hides; what is cut off apart."""
    family = int(pairs["drone_family"][index, drone])
    centre = np.asarray(pairs["drone_centre"][index, 0, drone], np.float64)
    corners = drone_model(family, 0).vertices @ np.asarray(pairs["drone_rotation"][index, 0, drone], np.float64).T
    corners = (corners + centre)[(corners + centre)[:, 2] > 0.05]
    half_px = float(pairs["focal"][index]) / 2 * corners[:, :2] / corners[:, 2:] + np.array([WIDTH, HEIGHT]) / 4
    outline = np.zeros(ids.shape, np.uint8)
    cv2.fillConvexPoly(outline, cv2.convexHull(np.round(half_px).astype(np.int32)), 1)
    nearer = depth < centre[2] - SIZES_M[family] / 2
    others = np.flatnonzero(pairs["drone_centre"][index, 0, :, 2] < centre[2]) + 1
    nearer |= np.isin(ids, others)
    return float((nearer & (outline > 0)).sum() / max(int(outline.sum()), 1))


def _distances(
    sightings: tuple[Sighting, ...], pairs: PairSet, index: int, depth: Array, ids: Array, found: _Found
) -> None:
    found.images += 1
    free = list(sightings)
    pixels = pairs["drone_pixels"][index, 0]
    for drone in np.argsort(-pixels):
        if pixels[drone] < 6:
            continue
        true = R_BODY_CAMERA @ np.asarray(pairs["drone_centre"][index, 0, drone], np.float64)
        range_m = float(np.linalg.norm(true))
        left, top, right, bottom = pairs["drone_box"][index, 0, drone]
        whole = left > 1 and top > 1 and right < WIDTH - 1 and bottom < HEIGHT - 1
        whole &= _hidden_share(pairs, index, int(drone), depth, ids) < WHOLE_HIDES
        near = [s for s in free if np.linalg.norm(s.position - true) < max(GATE * range_m, 0.5)]
        best = min(near, key=lambda s: float(np.linalg.norm(s.position - true)), default=None)
        error, sigma = 0.0, 1.0
        if best is not None:
            free.remove(best)
            error = float(np.linalg.norm(best.position)) / range_m - 1.0
            sigma = best.range_sigma_m / range_m
        found.drones.append((range_m, float(right - left), whole, best is not None, error, sigma))
    found.false += len(free)


if __name__ == "__main__":
    main()
