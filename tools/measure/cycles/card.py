"""What the shipped perception makes of moments whose truth is known, as figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.core.config import DroneConfig
from flockd.core.messages import UNCLASSED, PilotOutput
from flockd.flight.geometry import Rig, build_rig, rotation_angle_deg
from flockd.flight.perception import Networks, Observation
from flockd.flight.pilot import FlockPilot
from flockd.flight.pilot.pilot import StepTrace
from tools.measure.cycles.jobs import PROPELLER
from tools.measure.cycles.plan import STEP_S
from tools.measure.cycles.taken import Taken
from tools.measure.evaluation.on_pairs import MIN_PIXELS, pairings

Array = NDArray[Any]
WIDTHS_PX = ((6.0, 12.0), (12.0, 30.0), (30.0, 80.0), (80.0, 1e4))
RANGES_M = ((0.0, 5.0), (5.0, 10.0), (10.0, 1e3))
_MASK_PIXELS, _MASK_WITHIN_M = 30, 10.0
_DEPTH_WITHIN_M = 60.0
_EVERY = 7
"""One background pixel of so many squared is asked for its depth."""
_AT_BORDER_PX = 2


@dataclass(frozen=True)
class Sight:
    """A neighbour that at least one camera shows, and what was made of it."""

    number: int
    k: int
    """0 before the step, 1 after it."""
    drone: int
    """Which neighbour of the moment."""
    name: str
    range_m: float
    width_px: float
    """Of the box around all that is seen of it, in the camera that shows it largest."""
    cut: bool
    """By that image's border."""
    proposed: bool
    """Some proposal is no farther from it than the drone is large: the second stage was asked about it."""
    found: bool
    error: float
    """Relative, of the range; 0 where it was not found."""
    sigma: float
    """What was said of that error's standard deviation."""


@dataclass
class Findings:
    """All that was found in the pictures of one renderer by one rig."""

    frame_sets: int = 0
    images: int = 0
    sights: list[Sight] = field(default_factory=list)
    false: list[tuple[int, int, Array]] = field(default_factory=list)
    """Moment, instant, and the unit vector (3,) in the body of each detection that is no drone's."""
    ious: list[float] = field(default_factory=list)
    depth: list[Array] = field(default_factory=list)
    """Relative errors of background pixels, by image."""
    own_m: list[float] = field(default_factory=list)
    """Of the own displacement; NaN where there was no estimate."""
    own_deg: list[float] = field(default_factory=list)
    velocity_m_s: list[float] = field(default_factory=list)
    """Of neighbours that were found after the step; NaN where there was no estimate."""
    rejected: list[str] = field(default_factory=list)
    """Why images were not used."""


def look(config: DroneConfig, networks: Networks, moments: Iterable[Taken]) -> Findings:
    """Each moment is flown by a pilot that remembers nothing from before it."""
    found, rig = Findings(), build_rig(config.rig)
    for taken in moments:
        pilot = FlockPilot(config, networks)
        for k, frames in enumerate(taken.frame_sets(rig)):
            trace = StepTrace()
            out = pilot.step(frames, taken.vehicles[k], trace)
            assert trace.observation is not None
            found.frame_sets += 1
            found.images += len(rig.cameras)
            found.rejected += [reason.text for reason in out.reasons if reason.kind in ("camera", "lens")]
            asked = [proposal.roi.direction for proposal in trace.detection.proposals]
            _compare(taken, k, rig, trace.observation, out, found, asked)
        _own_motion(taken, out, found)
    return found


def _compare(
    taken: Taken, k: int, rig: Rig, seen: Observation, out: PilotOutput, found: Findings, asked: Sequence[Array]
) -> None:
    ids = taken.ids[k]
    solid = [np.count_nonzero(ids == n + 1, axis=(1, 2)) for n in range(len(taken.names))]
    shown = [n for n in range(len(taken.names)) if solid[n].max() > 0]
    places = [taken.R_ned_body[k].T @ (taken.neighbours[k, n] - taken.position[k]) for n in shown]
    pairs = pairings(seen.detections, places, [float(taken.sizes_m[n]) for n in shown])
    for row, (n, place) in enumerate(zip(shown, places, strict=True)):
        if solid[n].max() < MIN_PIXELS:
            continue
        range_m, detection = float(np.linalg.norm(place)), pairs.get(row)
        width, cut = _box(taken, k, n)
        proposed = any(_angle(one, place) <= taken.sizes_m[n] / range_m for one in asked)
        error = 0.0 if detection is None else detection.range_m / range_m - 1.0
        sigma = 1.0 if detection is None else detection.range_sigma_m / detection.range_m
        is_found, name = detection is not None, taken.names[n]
        found.sights.append(
            Sight(taken.number, k, n, name, range_m, width, cut, proposed or is_found, is_found, error, sigma)
        )
        if k == 1 and detection is not None:
            motion = out.neighbour_motions.get(detection.label)
            true = taken.R_ned_body[0].T @ (taken.neighbours[1, n] - taken.neighbours[0, n]) / STEP_S
            found.velocity_m_s.append(np.nan if motion is None else float(np.linalg.norm(motion.velocity - true)))
    used = {id(detection) for detection in pairs.values()}
    found.false += [(taken.number, k, one.bearing) for one in seen.detections if id(one) not in used]
    for c, name in enumerate(rig.cameras):
        camera = seen.cameras.get(name)
        if camera is None:
            continue
        said = (camera.labels > 0) & (camera.labels != UNCLASSED)
        found.ious += [
            iou_of(said, ids[c], n + 1)
            for n, place in zip(shown, places, strict=True)
            if solid[n][c] > _MASK_PIXELS and np.linalg.norm(place) < _MASK_WITHIN_M
        ]
        true = taken.range_m[k, c][::_EVERY, ::_EVERY]
        near = (true > 0.0) & (true < _DEPTH_WITHIN_M) & (ids[c][::_EVERY, ::_EVERY] == 0)
        if camera.depth is not None and near.any():
            found.depth.append(np.abs(camera.depth[::_EVERY, ::_EVERY][near] / true[near] - 1.0))


def iou_of(said: Array, ids: Array, drone: int) -> float:
    """Intersection over union of one drone's mask, within its box and a margin.

    ``said`` (h, w): where a drone is seen. What propellers blur, and other drones, counts for neither.
    """
    rows, columns = np.nonzero(ids % PROPELLER == drone)
    part = np.s_[max(0, rows.min() - 6) : rows.max() + 7, max(0, columns.min() - 6) : columns.max() + 7]
    counts = (ids[part] == drone) | (ids[part] == 0)
    mine, guess = (ids[part] == drone) & counts, said[part] & counts
    return float((mine & guess).sum() / max(int((mine | guess).sum()), 1))


def _box(taken: Taken, k: int, n: int) -> tuple[float, bool]:
    """Width in pixels, and whether it is cut, where neighbour ``n`` is seen largest."""
    of_drone = taken.ids[k] % PROPELLER == n + 1
    c = int(np.count_nonzero(of_drone, axis=(1, 2)).argmax())
    rows, columns = np.nonzero(of_drone[c])
    height, width = of_drone[c].shape
    low, high = (rows.min(), columns.min()), (rows.max() + 1, columns.max() + 1)
    cut = min(low) < _AT_BORDER_PX or high[0] > height - _AT_BORDER_PX or high[1] > width - _AT_BORDER_PX
    return float(high[1] - low[1]), bool(cut)


def _angle(a: Array, b: Array) -> float:
    return float(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1.0, 1.0)))


def _own_motion(taken: Taken, out: PilotOutput, found: Findings) -> None:
    ego = out.ego_motion
    if ego is None:
        found.own_m.append(np.nan)
        found.own_deg.append(np.nan)
        return
    moved = taken.position[1] - taken.position[0]
    found.own_m.append(float(np.linalg.norm(taken.R_ned_body[0] @ ego.translation - moved)))
    turned = taken.R_ned_body[0].T @ taken.R_ned_body[1]
    found.own_deg.append(float(rotation_angle_deg(ego.rotation.T @ turned)))


def rows(found: Findings) -> list[tuple[str, str]]:
    """The card of one renderer and rig: names and figures, with how many they were measured on in brackets."""
    lines = [("moments", str(found.frame_sets // 2))]
    for low, high in WIDTHS_PX:
        of = [one.found for one in found.sights if low <= one.width_px < high]
        lines.append((f"found, {_span(low, high, 'px')} wide", _share(of)))
    large = [one.proposed for one in found.sights if one.width_px >= WIDTHS_PX[1][0]]
    lines.append((f"proposed, {_span(WIDTHS_PX[1][0], 1e4, 'px')} wide", _share(large)))
    lines.append(("false, a frame set", _number(len(found.false) / found.frame_sets, found.frame_sets)))
    lines.append(("false in 500 pictures", f"{500 * len(found.false) / found.images:.0f}"))
    known = [one for one in found.sights if one.found and not one.cut]
    for low, high in RANGES_M:
        errors = np.array([one.error for one in known if low <= one.range_m < high])
        name = f"range at {_span(low, high, 'm')}"
        lines.append((f"{name}, median error", _percent(np.abs(errors), np.median, len(errors))))
        lines.append((f"{name}, 95th percentile", _percent(np.abs(errors), _p95)))
        lines.append((f"{name}, bias", _percent(errors, np.median)))
    for sigmas in (1, 2):
        inside = [abs(one.error) < sigmas * one.sigma for one in known]
        lines.append((f"range errors inside {sigmas} sigma", _share(inside)))
    lines.append(("mask IoU within 10 m, mean", _number(_figure(found.ious, np.mean), len(found.ious))))
    pixels = np.concatenate(found.depth) if found.depth else np.empty(0)
    lines.append(("background depth of a pixel, median", _percent(pixels, np.median)))
    pictures = [errors.mean() for errors in found.depth]
    lines.append(("the same, mean of a picture, median", _percent(pictures, np.median, len(pictures))))
    for name, values, unit in (
        ("own motion", found.own_m, "m"),
        ("own rotation", found.own_deg, "deg"),
        ("neighbour's velocity", found.velocity_m_s, "m/s"),
    ):
        finite = np.array(values)[np.isfinite(values)] if values else np.empty(0)
        lines.append((f"{name}, estimated", _share(list(np.isfinite(values)) if values else [])))
        lines.append((f"{name}, median error, {unit}", _number(_figure(finite, np.median), len(finite))))
        lines.append((f"{name}, 95th percentile, {unit}", _number(_figure(finite, _p95), len(finite))))
    return lines


def _span(low: float, high: float, unit: str) -> str:
    return f"{low:g} to {high:g} {unit}" if high < 1e3 else f"over {low:g} {unit}"


def by_shape(found: Findings) -> list[tuple[str, str, str, str]]:
    """Of each shape, where it is at least 12 px wide: name, share found, median bias and median error of its range."""
    lines = []
    for name in sorted({one.name for one in found.sights}):
        mine = [one for one in found.sights if one.name == name and one.width_px >= WIDTHS_PX[1][0]]
        errors = np.array([one.error for one in mine if one.found and not one.cut])
        bias, off = _percent(errors, np.median), _percent(np.abs(errors), np.median, len(errors))
        lines.append((name, _share([one.found for one in mine]), bias, off))
    return lines


def _p95(values: Any) -> Any:
    return np.quantile(values, 0.95)


def _figure(values: Any, of: Any) -> float:
    return float(of(np.asarray(values))) if len(values) else float("nan")


def _share(values: Sequence[Any]) -> str:
    return f"{100 * np.mean(values):.0f} % ({len(values)})" if len(values) else "-"


def _percent(values: Any, of: Any, count: int | None = None) -> str:
    brackets = "" if count is None else f" ({count})"
    return f"{100 * _figure(values, of):.1f} %{brackets}" if len(values) else "-"


def _number(value: float, count: int) -> str:
    return f"{value:.3g} ({count})" if np.isfinite(value) else "-"
