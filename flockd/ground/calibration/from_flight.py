"""What a flight found of its rig, by its recording: as a rig to fly with, where it is known and differs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.config.rig import RigConfig
from flockd.core.data import written_whole
from flockd.core.messages import CameraDeviation, PilotOutput
from flockd.flight.geometry import (
    RigidTransform,
    build_rig,
    described,
    differs,
    rig_faults,
    rolling,
    rotation_from_vector,
)
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.calibration.fragment import extrinsics_of, measured_today, rig_text
from flockd.onboard.message_json import from_json, parsed
from flockd.onboard.recording.mcap_file import RecordingError, read_entries
from flockd.onboard.recording.reader import Recording
from flockd.onboard.recording.streams import OUTPUT

MAX_TURN_RAD, MAX_OFFSET_S, MAX_FOCAL = math.radians(0.5), 0.01, 0.01
"""What is more uncertain than this is not known: the standard deviation of a mounting about its worst axis, of a time,
of a focal length."""


def found_rig(recording: Recording) -> tuple[CameraDeviation, ...]:
    """The last that the outputs of a recording say of its cameras; none: they say nothing. Raises RecordingError."""
    last: tuple[CameraDeviation, ...] = ()
    for entry in read_entries(recording.path):
        if entry.stream.topic == OUTPUT.topic:
            try:
                last = from_json(PilotOutput, parsed(entry.data)).rig or last
            except ValueError as error:
                damaged = f"the output of step {entry.sequence} is damaged: {error}"
                raise RecordingError(f"{recording.path}: {damaged}") from error
    names = {camera.name for camera in recording.config.rig.cameras}
    for one in last:
        if one.camera not in names or not _is_possible(one):
            raise RecordingError(f"{recording.path}: what it says of the rig, of camera {one.camera!r}, cannot be")
    return last


def corrected_rig(recording: Recording, source: str, out: Path) -> dict[str, Any]:
    """Writes the rig that the flight found to ``out`` and gives the result.

    What is not known well, and what differs by less than three standard deviations, stays as it was configured.
    Raises CalibrationError where nothing is to be taken over.
    """
    found = {one.camera: one for one in found_rig(recording)}
    if not found:
        raise CalibrationError(
            f"{source}: says nothing of the rig: it is shorter than some seconds, or was recorded by an older "
            "flockd; fly again"
        )
    config = recording.config.rig
    offset_s, note = _offset_s(list(found.values()))
    cameras, results, notes = [], {}, [] if note is None else [note]
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
            notes.append(
                f"the mounting of camera {camera.name!r} is known to {math.degrees(sigma_rad):.1f} degrees only, "
                "and kept: this flight turned too little about some axis"
            )
    if offset_s is None and not any(one["taken"] for one in results.values()):
        told = "; ".join([*notes, "what is known agrees with the configuration"])
        raise CalibrationError(f"{source}: nothing of the rig is to be corrected: {told}")
    total_s = round(config.time_offset_s + (offset_s or 0.0), 4)
    comment = (
        "The cameras of a drone, written by `flockd calibrate rig`. Put this in place of `rig` in your drone's file,",
        "then run `flockd config check` on that.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text(cameras, comment, total_s), encoding="utf-8")
    return {"cameras": results, "time_offset_s": total_s, "notes": notes, "out": str(out)}


def _offset_s(found: Sequence[CameraDeviation]) -> tuple[float | None, str | None]:
    """What is to be added to the rig's offset, or None; and a note where the cameras do not agree."""
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
    return (mean_s, note) if abs(mean_s) > 3.0 * sigma_s else (None, note)


def _is_possible(one: CameraDeviation) -> bool:
    readout = [of for of in (one.readout_s, one.readout_sigma_s) if of is not None]
    numbers = np.concatenate([one.turn, [one.time_offset_s, one.focal_scale], one.covariance.ravel(), *readout])
    if not (np.isfinite(numbers).all() and one.focal_scale > 0.0 and np.abs(numbers).max() < 100.0):
        return False
    return bool(np.allclose(one.covariance, one.covariance.T) and np.linalg.eigvalsh(one.covariance)[0] > 0.0)
