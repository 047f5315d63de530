"""Removed commands, keys and values of released versions, and keys of recordings, each with its replacement."""

from __future__ import annotations

from collections.abc import Mapping

_OPTIONS = (
    ("doctor", "unit", "`systemd-analyze security flockd` judges the unit"),
    ("replay", "trajectory", "`--json` gives the motion of each pair, to be put together"),
    ("replay", "calibration", "write the camera's matrix into the dataset's K.txt"),
    ("replay", "speed", "leave it out: a replay shows nothing while it runs"),
    (
        "calibrate rig",
        "by reference config every squares square-mm",
        "measure with a tape, fly, and take over what the flight found with `--from-flight RECORDING`",
    ),
    ("calibrate rig", "max-offset", "a flight finds the time offset: `--from-flight RECORDING`"),
    ("sim", "flow", "write `--set drone.perception.flow=VALUE`"),
    ("sim", "scale", "write `--set drone.perception.scale=VALUE`"),
    ("sim", "swap", "`--perception truth` flies on exact states; a network's share of an error is no longer measured"),
    (
        "calibrate camera",
        "size pixel-format",
        "`flockd cameras --write FILE` writes the cameras that are plugged in; name that with --config",
    ),
    (
        "calibrate camera",
        "dictionary marker-mm",
        "print flockd's own board with `flockd calibrate camera --print-board`",
    ),
    ("calibrate camera", "views max-blur serial seconds", "leave it out"),
    ("calibrate camera", "every", "leave it out: all images of a folder are read"),
    ("calibrate camera", "picture", "the command prints the coverage and each view's residual"),
)
COMMANDS: Mapping[str, str] = {
    **{f"flockd {of} --{option}": instead for of, options, instead in _OPTIONS for option in options.split()},
    "flockd models bench": "`flockd replay RECORDING --profile` times the stages with the networks of --config",
    "flockd record cut": "`flockd replay RECORDING --start S --end S --out FILE` flies the stretch again",
    "flockd record export": "read it in Python: docs/python.md has a program",
    "flockd record recover": "leave it out: what is whole of a recording is read",
    "flockd view": "open the recording in Foxglove, or in Rerun after `rerun mcap convert RECORDING.mcap -o X.rrd`",
}
"""Replacements by command, or command and option, as written on the command line."""

KEYS: Mapping[str, str] = {
    "autopilot.arm_and_take_off": "leave it out: a pilot or a ground station arms, takes off and selects offboard",
    "autopilot.max_heartbeat_age_s": "write `heartbeat_timeout_s` in the section `safety`",
    "autopilot.velocity_trim_memory": "delete it: a filter weighs the cameras' velocity and the autopilot's",
    "desired": "write the section `mission`, with `kind: circle_then_tangent` for the same flight",
    "geometry.max_drone_pixels": "delete it: the tracker finds velocities from bearings and ranges alone",
    "geometry.max_acceleration_m_s2": "delete it: ego-motions are compared with the autopilot's velocity",
    "geometry.max_refused_ego_motions": "delete it: ego-motions are compared with the autopilot's velocity",
    "geometry.method": "delete it: the own motion begins with Algorithm 1",
    "geometry.min_drone_pairs": "delete it: the tracker finds velocities from bearings and ranges alone",
    "geometry.neighbour_velocity_caution": "delete it: the tracker finds velocities from bearings and ranges alone",
    "perception.detection.colour_weight": "delete it: masks are the first stage's",
    "perception.detection.depth_map_sigma": "delete it: `perception.distance` gives every range",
    "perception.detection.max_residuals": "delete it: only what is segmented or predicted is proposed",
    "perception.detection.occlusion": "delete it: the nearer of two does not hide the farther any more",
    "perception.detection.prediction_gate": "delete it: what is found where a track was predicted counts as all else",
    "perception.detection.residual_distance_px": "delete it: only what is segmented or predicted is proposed",
    "perception.detection.residual_px": "delete it: only what is segmented or predicted is proposed",
    "perception.flow_refinement_scale": "delete it: `dis` stops at half the size",
    "recording.file_mb": "delete it: a flight is one file",
    "rig.cameras.extrinsics.measured.residual_deg": "delete it: a flight tells mountings, with standard deviations",
    "safety.degraded_gusts_m_s": "write `degraded_velocity_error_m_s`",
    "safety.gate.max_drift_m_s": "delete it: wind is left to the autopilot",
    "tracking.hiding_stranger_probability": "delete it: what has a missed neighbour's bearing and size is it, at first",
    "tracking.size_correlation": "delete it: errors of range and size count as independent",
    "tracking.own_manoeuvre_memory_s": "delete it: each neighbour may begin to manoeuvre harder at any time",
    "safety.gate.response_s": "delete it, and write `reaction_s`, which contains it",
    "safety.max_gusts_m_s": "write `max_velocity_error_m_s`",
    "safety.degraded_ego_motion_failures": "write `degraded_ego_motion_s`, in seconds instead of steps",
    "safety.max_ego_motion_failures": "write `max_ego_motion_s`, in seconds instead of steps",
}
"""By a drone's, scenario's or campaign's key, with dots, and without `drone` before those of a drone in a scenario."""

MANIFEST_KEYS: Mapping[str, str] = {
    "outputs.depth.unknown": "choose a depth network that gives metres: most relative ones have a metric version",
}
"""By a manifest's key, without the name of an output."""

VALUES = (("flocking.size", "auto"), ("flocking.size", "weave"))
"""Keys and their values that recordings of earlier versions hold, and that this one takes for the default."""
