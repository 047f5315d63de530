"""Measure the shipped networks on rendered worlds that they never saw, and print one table.

python -m tools.training.render_training_data DATA/test   --split test --worlds 25 --pairs 12
python -m tools.training.render_training_data DATA/unseen --split test --worlds 25 --pairs 12 --families unseen
python -m tools.measure.evaluate_networks --data DATA/test --unseen DATA/unseen

How long they take says `flockd replay RECORDING --profile`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.core.choices import ROLES, ScaleSource
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.messages import UNCLASSED, Detection, Frame, FrameSet, VehicleState
from flockd.flight.geometry import RangeMap, Rig, RigCamera
from flockd.flight.perception import OnnxNetworks, Perception
from flockd.flight.perception.flow import DisFlow
from flockd.flight.pilot.ground import level_ground
from flockd.sim.renderer.drone_models import FAMILIES, drone_model
from tools.training.dataset import R_BODY_CAMERA, PairSet, open_pairs, rig_camera

Array = NDArray[Any]
SIZES_M = [drone_model(family, 0).size_m for family in range(FAMILIES)]
MIN_PIXELS = 6
"""Drones with fewer visible pixels do not count, neither as found nor as missed."""
MASK_WITHIN_M = 10.0
HEIGHT_SIGMA_M = 0.1
"""Standard deviation of the height above ground that an autopilot gives, by its barometer."""
RANGES_M = ((1.5, 5.0), (5.0, 10.0), (10.0, 20.0))
WITH: dict[ScaleSource, str] = {
    "network": "RGB alone",
    "height": f"attitude, height by barometer ({HEIGHT_SIGMA_M:g} m)",
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
    parser.add_argument("--float", action="store_true", help="the float networks, not their 8-bit twins")
    arguments = parser.parse_args()
    config = PerceptionConfig(threads=2)
    if arguments.float:
        config = config.model_copy(update={role: getattr(config, role).removesuffix("_int8") for role in ROLES})
    perception = OnnxNetworks(config, arguments.models)

    rows = list(rows_of_pairs(look_at_pairs(open_pairs(arguments.data), perception)))
    if arguments.unseen is not None:
        rows += list(_distances(look_at_pairs(open_pairs(arguments.unseen), perception), ", unseen families"))
    for row in rows:
        print(row)


def rows_of_pairs(found: Findings) -> Iterator[Row]:
    """Of drones, depth, masks and flow."""
    yield from _distances(found, "")
    whole = [drone for drone in found.drones if drone.found and drone.whole]
    for sigmas in (1, 2):
        inside = float(np.mean([abs(drone.error) < sigmas * drone.sigma for drone in whole]))
        yield Row(f"distance errors inside {sigmas} sigma", 100 * inside, "%", len(whole))
    for given, name in WITH.items():
        images = found.depth[given]
        what = f"background depth, relative error, {name}, median"
        yield Row(what, 100 * float(np.median(images)), "%", len(images))
    yield Row(f"mask IoU, drones within {MASK_WITHIN_M:g} m, mean", float(np.mean(found.iou)), "", len(found.iou))
    for low, high, name in ((12, np.inf, "at least 12"), (6, 12, "6 to 12")):
        wide = [drone for drone in found.drones if low <= drone.width_px < high]
        share = 100 * sum(drone.found for drone in wide) / max(len(wide), 1)
        yield Row(f"drones whose box is {name} px wide, found", share, "%", len(wide))
    yield Row("false drones in 500 images", 500 * found.false / found.images, "", found.images)
    errors = {key: np.concatenate(parts) for key, parts in found.flow.items()}
    for on_drones, where in ((False, "background"), (True, "drones")):
        for network, name in (("network", "flow"), ("dis", "OpenCV DIS medium")):
            off = errors[network, on_drones]
            for kind, figure in (("median", np.median), ("mean", np.mean)):
                yield Row(f"{name} on {where}, end-point error, {kind}", float(figure(off)), "px", len(off))
    ours, of_dis = (np.concatenate([errors[network, d] for d in (False, True)]) for network in ("network", "dis"))
    what = "flow, mean end-point error as a share of OpenCV DIS medium's"
    yield Row(what, float(ours.mean() / of_dis.mean()), "", ours.size)


def _distances(found: Findings, note: str) -> Iterator[Row]:
    for low, high, whole in [(low, high, True) for low, high in RANGES_M] + [(0.0, 10.0, False)]:
        mine = [d.error for d in found.drones if d.found and d.whole is whole and low <= d.range_m < high]
        what = f"whole, {low:g}-{high:g} m" if whole else f"cut or hidden, within {high:g} m"
        if mine:
            off = np.abs(mine)
            figures = {"median": np.median(off), "p95": np.quantile(off, 0.95), "bias": np.median(mine)}
            for name, figure in figures.items():
                yield Row(f"distance{note}, {what}, {name}", 100 * float(figure), "%", len(mine))


@dataclass(frozen=True)
class Drone:
    """One drone in one image, and its detection."""

    range_m: float
    width_px: float
    whole: bool
    found: bool
    error: float
    """Relative error of its range; 0 where it was not found."""
    sigma: float
    """The detection's relative standard deviation of range."""


class Findings:
    """Counts and errors over all pairs."""

    def __init__(self) -> None:
        self.images = 0
        self.false = 0
        """Detections that are no drone's, or a drone's second one."""
        self.drones: list[Drone] = []
        self.iou: list[float] = []
        self.depth: dict[ScaleSource, list[float]] = {scale: [] for scale in WITH}
        """Mean relative error of the background's depth in each image, by what gave the scale."""
        self.flow: dict[tuple[str, bool], list[Array]] = {}
        """End-point errors, px, of ("network" or "dis", on drones)."""


def look_at_pairs(pairs: PairSet, networks: OnnxNetworks) -> Findings:
    """The second stage and all, on each pair's first image; the flow on both. Drones: with the autopilot's height."""
    rng = np.random.Generator(np.random.PCG64(0))
    dis, found = DisFlow(), Findings()
    for index in range(pairs.count):
        rig = Rig({"camera": rig_camera(float(pairs["focal"][index]))})
        images = np.asarray(pairs["image"][index])
        R_ned_camera = np.asarray(pairs["R_ned_camera"][index, 0], np.float64)
        measured_m = float(pairs["height"][index, 0]) + HEIGHT_SIGMA_M * float(rng.standard_normal())
        vehicle = VehicleState(0.0, R_ned_camera @ R_BODY_CAMERA.T, measured_m)
        frames = FrameSet(0.0, {"camera": Frame("camera", images[0], 0.0, 0)})
        depth, ids = np.asarray(pairs["depth"][index][0], np.float32), np.asarray(pairs["ids"][index][0])
        for scale in WITH:
            perception = Perception(rig, networks, PerceptionConfig(scale=scale))
            view = perception.observe(frames, vehicle, level_ground(vehicle))
            ranges = view.cameras["camera"].depth
            assert ranges is not None
            off = depth_errors(RangeMap(ranges), rig.cameras["camera"], depth, ids)
            found.depth[scale].append(float(off.mean()) if off.size else 0.0)
        labels = view.cameras["camera"].labels
        _masks(((labels > 0) & (labels != UNCLASSED))[1::2, 1::2], ids, pairs, index, found)
        compare_drones(view.detections, pairs, index, found)
        flow = np.asarray(pairs["flow"][index], np.float32)
        valid = np.asarray(pairs["flow_valid"][index])
        first, second = (Frame("camera", images[k], 0.5 * k, k) for k in (0, 1))
        ours = networks.flow(first, second, labels)
        for name, guess in (("network", ours), ("dis", dis.flow(images[0], images[1]))):
            error = np.linalg.norm(np.moveaxis(guess[1::2, 1::2], 2, 0) - flow, axis=0)
            for on_drones in (False, True):
                found.flow.setdefault((name, on_drones), []).append(error[valid & ((ids > 0) == on_drones)])
    return found


def depth_errors(ranges: RangeMap, camera: RigCamera, true: Array, ids: Array) -> Array:
    """(n,) relative errors of ranges (h, w) where the background of a rendered pair is near.

    ``true`` (h / 2, w / 2) metres along the optical axis, as rendered; ``ids`` alike, 0 where there is no drone.
    """
    guess = (ranges * camera.camera.block_rays(1)[..., 2])[1::2, 1::2]
    near = (ids == 0) & (true < 60.0)
    return np.asarray(np.abs(guess[near] - true[near]) / true[near])


def _masks(guess: Array, ids: Array, pairs: PairSet, index: int, found: Findings) -> None:
    """IoU of every near drone, over its box with a margin."""
    for drone in np.flatnonzero(pairs["drone_pixels"][index, 0] > 30):
        if np.linalg.norm(pairs["drone_centre"][index, 0, drone]) > MASK_WITHIN_M:
            continue
        left, top, right, bottom = (pairs["drone_box"][index, 0, drone] / 2).astype(int)
        part = np.s_[max(0, top - 3) : bottom + 3, max(0, left - 3) : right + 3]
        other = (ids[part] > 0) & (ids[part] != drone + 1)
        mine, said = (ids[part] == drone + 1), guess[part] & ~other
        found.iou.append(float((mine & said).sum() / max((mine | said).sum(), 1)))


def compare_drones(detections: tuple[Detection, ...], pairs: PairSet, index: int, found: Findings) -> None:
    """Count every drone of a pair's first image: a detection is a drone's if it lies in its direction, at any range."""
    found.images += 1
    seen = np.flatnonzero(pairs["drone_pixels"][index, 0] >= MIN_PIXELS)
    places = [R_BODY_CAMERA @ np.asarray(pairs["drone_centre"][index, 0, drone], np.float64) for drone in seen]
    sizes_m = [SIZES_M[int(pairs["drone_family"][index, drone])] for drone in seen]
    detection_of = pairings(detections, places, sizes_m)
    for row, (drone, true) in enumerate(zip(seen, places, strict=True)):
        range_m, best = float(np.linalg.norm(true)), detection_of.get(row)
        left, _, right, _ = pairs["drone_box"][index, 0, drone].tolist()
        error, sigma = 0.0, 1.0
        if best is not None:
            distance = float(np.linalg.norm(best.position))
            error, sigma = distance / range_m - 1.0, best.range_sigma_m / distance
        whole = bool(pairs["drone_whole"][index, 0, drone])
        found.drones.append(Drone(range_m, right - left, whole, best is not None, error, sigma))
    found.false += len(detections) - len(detection_of)


def pairings(
    detections: Sequence[Detection], places: Sequence[Array], sizes_m: Sequence[float]
) -> dict[int, Detection]:
    """The detection of each drone that was found: first those that lie nearest to each other."""
    away = sorted(
        (_angle(detection.position, place) / (size_m / 2 / float(np.linalg.norm(place))), drone, number)
        for number, detection in enumerate(detections)
        for drone, (place, size_m) in enumerate(zip(places, sizes_m, strict=True))
    )
    pairings: dict[int, int] = {}
    for share, drone, number in away:
        if share <= 1.0 and drone not in pairings and number not in pairings.values():
            pairings[drone] = number
    return {drone: detections[number] for drone, number in pairings.items()}


def _angle(a: Array, b: Array) -> float:
    return float(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1, 1)))


if __name__ == "__main__":
    main()
