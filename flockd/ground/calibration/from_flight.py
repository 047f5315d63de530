"""Corrects a rig by the recording of a flight, where the flight determines a value and it differs."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.config.rig import RigConfig
from flockd.core.data import written_whole
from flockd.flight.geometry import Rig, RigidTransform, build_rig, rotation_from_vector
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.flight.pilot.camera_agreement import moves_otherwise
from flockd.flight.pilot.motions import background_pairs
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.calibration.fragment import extrinsics_of, measured_today, rig_text
from flockd.ground.calibration.rig_calibration import (
    CameraDeviation,
    RigCalibration,
    Seen,
    described,
    differs,
    rig_faults,
    rolling,
)
from flockd.onboard.daemon import load_side_by_side
from flockd.onboard.recording.mcap_file import RecordingError
from flockd.onboard.recording.reader import Recording
from flockd.onboard.recording.streams import is_image

MAX_TURN_RAD, MAX_OFFSET_S, MAX_FOCAL = math.radians(0.5), 0.01, 0.01
"""Largest standard deviations of a mounting about its worst axis, of a time, and of a focal length that are taken
over."""
LEAST_S = 5.0
"""Shortest flight that is judged."""
_JUDGED = 60
"""Number of first looks of which the earlier half is judged by the later one."""
Look = tuple[Seen, Seen, PointPairs]


def found_rig(
    recording: Recording, last_s: float = math.inf, progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[CameraDeviation, ...]:
    """The deviation of each camera in the last seconds of a flight, whose steps are computed again; empty: it is too
    short.

    ``progress`` is called with the steps done and their total. Raises RecordingError without images, and ModelError.
    """
    if not any(map(is_image, recording.contents.messages)):
        raise RecordingError(f"{recording.path}: holds no images, which the calibration needs; name another recording")
    config, began_s = recording.config, recording.start_s + recording.duration_s - last_s
    total = sum(began_s <= time_s for _, time_s in recording.contents.steps)
    pilot = FlockPilot(config, load_side_by_side(config), learned=recording.learned)
    rig = build_rig(config.rig)
    calibration: RigCalibration | None = None
    looks, looks_s, told = list[Look](), 0.0, set[str]()
    before: Seen | None = None
    for done, step in enumerate(recording.steps(began_s), start=1):
        trace = StepTrace()
        output = pilot.step(step.frames, step.vehicle, trace, step.order)
        told |= {reason.text for reason in output.reasons} | set((step.output or {}).get("reasons", ()))
        observation, after = trace.observation, None
        if observation is not None:
            times_s = {name: frame.time_s for name, frame in step.frames.frames.items()}
            after = Seen(observation.vehicle, step.frames.time_s, times_s)
            if before is not None and observation.previous and observation.previous.time_s == before.frames_s:
                with contextlib.suppress(ValueError):  # no depth has a scale, or no camera both frames
                    look = before, after, background_pairs(rig, observation, config.geometry)
                    looks_s += observation.interval_s
                    if calibration is not None:
                        calibration.update(*look)
                    else:
                        looks.append(look)
                        calibration = calibrated(rig, looks) if len(looks) == _JUDGED else None
        before = after
        progress(done, total)
    if looks_s < LEAST_S:
        return ()
    calibration = calibration or calibrated(rig, looks)
    return tuple(
        replace(one, elsewhere=one.elsewhere or any(text.startswith(moves_otherwise(one.camera)) for text in told))
        for one in calibration.deviations()
    )


def calibrated(rig: Rig, looks: Sequence[Look]) -> RigCalibration:
    """The filter after these looks, without the measurements that contradict what the later half of them shows.

    While nothing is known, wrong matches are believed: as drones start, one of the first looks turned the rigs of two
    of eight simulated flights of 10 s by seven standard deviations, and a filter that had used it did not contradict.
    """
    later = RigCalibration(rig)
    for look in looks[len(looks) // 2 :]:
        later.update(*look)
    calibration = RigCalibration(rig, later)
    for look in looks:
        calibration.update(*look)
    return calibration


def corrected_rig(
    recording: Recording, deviations: Sequence[CameraDeviation], source: str, out: Path
) -> dict[str, Any]:
    """Writes the recording's rig, corrected by `found_rig`, to ``out``, and returns the result.

    Values that are not known well, or differ by less than four standard deviations, stay as configured. Raises
    CalibrationError if no value is corrected.
    """
    found = {one.camera: one for one in deviations}
    if not found:
        raise CalibrationError(f"{source}: does not show the rig: it is shorter than {LEAST_S:g} s; fly again")
    config = recording.config.rig
    offset_s, note = _offset_s(list(found.values()))
    cameras, results, notes, vague = [], {}, [] if note is None else [note], dict[str, float]()
    notes += rolling(next(iter(found.values())))
    for camera in config.cameras:
        one = found[camera.name]
        off, sigmas = differs(one), np.sqrt(np.diag(one.covariance))
        sigma_rad = math.sqrt(float(np.linalg.eigvalsh(one.covariance[:3, :3])[-1]))  # about the axis known worst
        changes: dict[str, Any] = {}
        measured = measured_today(camera=camera.name, source=f"{source}, in flight", views=1)
        if off.turn and sigma_rad < MAX_TURN_RAD and not one.elsewhere:
            before = build_rig(RigConfig(cameras=(camera,))).cameras[camera.name].T_body_camera
            after = RigidTransform(rotation_from_vector(one.turn) @ before.rotation, before.translation)
            changes["extrinsics"] = extrinsics_of(after, measured)
        if off.focal and sigmas[4] < MAX_FOCAL and not one.elsewhere:
            focal = {key: round(getattr(camera.intrinsics, key) * one.focal_scale, 4) for key in ("fx", "fy")}
            changes["intrinsics"] = camera.intrinsics.model_copy(update={**focal, "measured": measured})
        cameras.append(camera.model_copy(update=changes))
        results[camera.name] = {
            **cameras[-1].extrinsics.model_dump(mode="json", exclude={"measured"}),
            "fx": cameras[-1].intrinsics.fx,
            "fy": cameras[-1].intrinsics.fy,
            "taken": [{"extrinsics": "mounting", "intrinsics": "focal length"}[key] for key in changes],
            "found": described(one),
            "sigma_deg": math.degrees(sigma_rad),
            "time_offset_s": one.time_offset_s,
            "sigma_s": float(sigmas[3]),
            "focal_scale": one.focal_scale,
            "sigma_focal": float(sigmas[4]),
        }
        if one.elsewhere:
            notes.append(*rig_faults(one))
        elif sigma_rad > MAX_TURN_RAD:
            vague[camera.name] = math.degrees(sigma_rad)
    if vague:
        told = f"the mounting of {', '.join(vague)} is known to {max(vague.values()):.1f} degrees only, and kept"
        notes.append(f"{told}: this flight turned too little about some axis")
    if offset_s is None and not any(one["taken"] for one in results.values()):
        told = "; ".join([*notes, "what is known agrees with the configuration"])
        raise CalibrationError(f"{source}: the rig needs no correction: {told}")
    total_s = round(config.time_offset_s + (offset_s or 0.0), 4)
    comment = (
        "The cameras of a drone, written by `flockd calibrate rig`. Put this in place of `rig` in your drone's file,",
        "then run `flockd config check` on that.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text(cameras, comment, total_s), encoding="utf-8")
    return {"cameras": results, "time_offset_s": total_s, "notes": notes, "out": str(out)}


def _offset_s(found: Sequence[CameraDeviation]) -> tuple[float | None, str | None]:
    """The correction of the rig's time offset, or None; and a note if the cameras do not agree."""
    known = [one for one in found if not one.elsewhere and math.sqrt(one.covariance[3, 3]) < MAX_OFFSET_S]
    if not known:
        return None, "the time of the cameras is not known, and kept: this flight turned too evenly"
    offsets_s = np.array([one.time_offset_s for one in known])
    mean_s = float(np.average(offsets_s, weights=[1.0 / one.covariance[3, 3] for one in known]))
    sigma_s = min(math.sqrt(one.covariance[3, 3]) for one in known)  # their errors are the autopilot's together
    note = None
    apart_s = np.abs(offsets_s - mean_s)
    if apart_s.max() > MAX_OFFSET_S:
        worst = known[int(apart_s.argmax())].camera
        note = f"the time of camera {worst!r} is {1e3 * apart_s.max():.0f} ms off the others'; the offset is their mean"
    return (mean_s, note) if abs(mean_s) > 4.0 * sigma_s else (None, note)
