"""Removed commands, keys and values of earlier versions, each with its replacement."""

from __future__ import annotations

from collections.abc import Mapping

_OPTIONS = (
    ("config new", "name", "write `--set name=NAME`, of a scenario `--set scenario=NAME`"),
    ("config new", "number", "write `--set safety.first_flight_layer=N`"),
    (
        "config new",
        "cameras size field-of-view source",
        "`flockd cameras --write FILE` writes those that are plugged in",
    ),
    ("config new", "autopilot", "write `--set autopilot.address=ADDRESS`"),
    ("config new", "fleet", "write `--set telemetry.fleet=NAME`"),
    ("config new", "mission", "write `--set 'mission={kind: KIND}'`"),
    ("config new", "defaults", "leave it out: nothing is asked"),
    ("config new", "drones", "leave it out, and say it to `flockd sim FILE --drones N`"),
    ("config new", "duration", "write `--set duration_s=S`"),
    ("config new", "obstacles", "write `--set world.obstacles.kind=KIND --set obstacles.enabled=true`"),
    ("config new", "drone", "write `--set drone=FILE`"),
    ("doctor", "minutes", "run `flockd run` with propellers off, and watch `flockd status`"),
    ("doctor", "unit", "`systemd-analyze security flockd` judges the unit"),
    ("fleet", "recordings", "`flockd report FOLDER` writes a report of the recordings that plays them"),
    ("replay", "trajectory", "`--json` gives the motion of each pair, to be put together"),
    ("replay", "calibration", "write the camera's matrix into the dataset's K.txt"),
    ("replay", "speed", "leave it out: a replay shows nothing while it runs"),
    ("campaign", "engine address", "each computer flies a part of the values, of a file of its own"),
    ("report", "video drone", "open the recording in Foxglove, which plays its images"),
    ("report", "ulog", "open PX4's log in Flight Review or PlotJuggler"),
    ("cameras", "measure", "`flockd cameras --picture FOLDER` measures"),
    (
        "calibrate rig",
        "by reference config every squares square-mm",
        "measure with a tape, fly, and take over what the flight found with `--from-flight RECORDING`",
    ),
    ("calibrate rig", "max-offset", "a flight finds the time offset: `--from-flight RECORDING`"),
    ("detect", "labels", "`python -m tools.measure.labelled` measures what `--json` wrote"),
    ("sim", "flow", "write `--set drone.perception.flow=VALUE`"),
    ("sim", "scale", "write `--set drone.perception.scale=VALUE`"),
    ("sim", "height", "write `--set drone.perception.height=VALUE`"),
    ("sim", "wind", "write `--set vehicle.wind_m_s=VALUE`"),
    ("sim", "speed", "write `--set drone.mission.speed_m_s=VALUE`"),
    ("sim", "radius", "write `--set drone.mission.radius_m=VALUE`"),
    ("sim", "cameras", "write `--set cameras.preset=VALUE`"),
    ("sim", "no-browser", "leave it out: the address is printed, and no browser opened"),
    ("sim", "swap", "`--perception truth` flies on exact states; a network's share of an error is no longer measured"),
    ("sim", "verbose", "the report says what was flown, and `flockd config show SCENARIO` what a file stands for"),
    (
        "calibrate camera",
        "size pixel-format turn-deg",
        "`flockd cameras --write FILE` writes the cameras that are plugged in; name that with --config",
    ),
    (
        "detect",
        "models first-stage detector second-stage verification threads",
        "write it in the section `perception` of a drone's file, and name that with --config",
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
    "flockd foxglove": "watch live with `flockd fleet`, or in ROS 2 with `flockd ros`; Foxglove opens recordings",
    "flockd models bench": "`flockd replay RECORDING --profile` times the stages with the networks of --config",
    "flockd calibrate drone": "measure from tip to tip, with propellers, and write `perception.drone_size_m`",
    "flockd record cut": "`flockd replay RECORDING --start S --end S --out FILE` flies the stretch again",
    "flockd record export": "read it in Python: docs/python.md has a program",
    "flockd record recover": "leave it out: what is whole of a recording is read",
    "flockd view": "open the recording in Foxglove, or in Rerun after `rerun mcap convert RECORDING.mcap -o X.rrd`",
}
"""Replacements by command, or command and option, as written on the command line."""

KEYS: Mapping[str, str] = {
    "autopilot.arm_and_take_off": "leave it out: a pilot or a ground station arms, takes off and selects offboard",
    "autopilot.max_heartbeat_age_s": "write `heartbeat_timeout_s` in the section `safety`",
    "autopilot.obstacle_distance": "delete it, and set PX4's CP_DIST to -1: flockd stops no pilot who flies by hand",
    "autopilot.velocity_trim_memory": "delete it: a filter weighs the cameras' velocity and the autopilot's",
    "cameras.attitude": "delete it, and write `timing.delay_s`: what counts is images against attitudes",
    "cameras.automatic": "delete it: exposure and white balance of simulated cameras are fixed",
    "cameras.compression.h264_mbit_s": "write `jpeg_quality`; streams are no longer simulated",
    "detections.latency_s": "write `latency_s` beside `detections`",
    "cameras.lens.dirt": "delete it: simulated lenses are clean",
    "cameras.lens.drops": "delete it: simulated lenses are clean",
    "desired": "write the section `mission`, with `kind: circle_then_tangent` for the same flight",
    "errors": "delete it, and write the section `detections` in the scenario, for `perception: truth`",
    "faults.kind": "delete it: a camera that fails delivers no images",
    "faults.sigma": "delete it: a camera that fails delivers no images",
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
    "stop": "delete it: all `seeds` are flown",
    "rig.cameras.extrinsics.measured.residual_deg": "delete it: a flight tells mountings, with standard deviations",
    "safety.degraded_gusts_m_s": "write `degraded_velocity_error_m_s`",
    "safety.gate.max_drift_m_s": "delete it: wind is left to the autopilot",
    "tracking.first_acceleration_sigma_m_s2": "delete it: each neighbour may begin to manoeuvre harder at any time",
    "tracking.hiding_stranger_probability": "delete it: what has a missed neighbour's bearing and size is it, at first",
    "tracking.size_correlation": "delete it: errors of range and size count as independent",
    "tracking.own_manoeuvre_memory_s": "delete it: each neighbour may begin to manoeuvre harder at any time",
    "take_off_apart_s": "delete it: simulated drones take off together",
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
