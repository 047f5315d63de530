"""What earlier versions had and this one has not: for each, what to use instead."""

from __future__ import annotations

from collections.abc import Mapping

_CAMERAS = "change them in the file; `flockd cameras --write FILE` writes the sections for what is plugged in"

COMMANDS: Mapping[str, str] = {
    **{
        f"flockd config new {kind} --{option}": instead
        for kind, options in {
            "drone": {
                "name": "write `--set name=NAME`",
                "number": "write `--set safety.first_flight_layer=N`",
                **dict.fromkeys(("cameras", "size", "field-of-view", "source"), _CAMERAS),
                "autopilot": "write `--set autopilot.address=ADDRESS`",
                "fleet": "write `--set telemetry.fleet=NAME`",
                "mission": "write `--set 'mission={kind: KIND}'`",
                "defaults": "leave it out: nothing is asked",
            },
            "scenario": {
                "name": "write `--set scenario=NAME`",
                "drones": "leave it out, and say it to `flockd sim FILE --drones N`",
                "duration": "write `--set duration_s=S`",
                "mission": "write `--set 'mission={kind: KIND}'`",
                "obstacles": "write `--set world.obstacles.kind=KIND --set obstacles.enabled=true`",
                "drone": "write `--set drone=FILE`",
                "defaults": "leave it out: nothing is asked",
            },
        }.items()
        for option, instead in options.items()
    },
    **dict.fromkeys(
        ("flockd doctor --bench", "flockd doctor --minutes"),
        "run `flockd run` with propellers off, and watch `flockd status`",
    ),
    "flockd doctor --unit": "`systemd-analyze security flockd` judges the unit",
    "flockd fleet --recordings": "`flockd report FOLDER` writes a report of the recordings that plays them",
    "flockd foxglove": "watch live with `flockd fleet`, or in ROS 2 with `flockd ros`; Foxglove opens recordings",
    "flockd record export --ros2": "Foxglove opens the recording itself; record a flight's topics of `flockd ros`",
    "flockd record export --format": "tables are CSV, which pandas, Polars and DuckDB read too; leave it out",
    "flockd models bench": "`flockd replay RECORDING --profile` times the stages with the networks of --config",
    "flockd replay --trajectory": "`--json` gives the motion of each pair, to be put together",
    "flockd replay --calibration": "write the camera's matrix into the dataset's K.txt",
    "flockd replay --speed": "leave it out: a replay shows nothing while it runs",
    "flockd report --ulog": "open PX4's log in Flight Review or PlotJuggler",
    "flockd cameras --measure": "`flockd cameras --picture FOLDER` measures",
    **dict.fromkeys(
        (
            f"flockd calibrate rig --{option}"
            for option in ("by", "reference", "config", "every", "squares", "square-mm")
        ),
        "measure with a tape, fly, and take over what the flight found with `--from-flight RECORDING`",
    ),
    "flockd calibrate rig --max-offset": "a flight finds the time offset: `--from-flight RECORDING`",
    **{
        f"flockd sim --{option}": f"write `--set {key}=VALUE`"
        for option, key in {
            "flow": "drone.perception.flow",
            "scale": "drone.perception.scale",
            "height": "drone.perception.height",
            "wind": "vehicle.wind_m_s",
            "speed": "drone.mission.speed_m_s",
            "radius": "drone.mission.radius_m",
            "cameras": "cameras.preset",
        }.items()
    },
    "flockd sim --verbose": "the report says what was flown, and `flockd config show SCENARIO` what a file stands for",
    **dict.fromkeys(
        (f"flockd calibrate camera --{option}" for option in ("size", "pixel-format", "turn-deg")),
        "`flockd cameras --write FILE` writes the cameras that are plugged in; name that with --config",
    ),
    **dict.fromkeys(
        (
            f"flockd detect --{option}"
            for option in ("models", "first-stage", "detector", "second-stage", "verification", "threads")
        ),
        "write it in the section `perception` of a drone's file, and name that with --config",
    ),
    **dict.fromkeys(
        (f"flockd calibrate camera --{option}" for option in ("dictionary", "marker-mm")),
        "print flockd's own board with `flockd calibrate camera --print-board`",
    ),
    **dict.fromkeys(
        (f"flockd calibrate camera --{option}" for option in ("views", "max-blur", "serial", "seconds")),
        "leave it out",
    ),
    "flockd calibrate drone": "measure from tip to tip, with propellers, and write `perception.drone_size_m`",
    "flockd calibrate camera --picture": "the command prints the coverage and each view's residual",
    "flockd view": "open the recording in Foxglove, or in Rerun after `rerun mcap convert RECORDING.mcap -o X.rrd`",
}
"""By a command, or a command and its option, as they were written on the command line."""

KEYS: Mapping[str, str] = {
    "autopilot.arm_and_take_off": "leave it out: a pilot or a ground station arms, takes off and selects offboard",
    "autopilot.max_heartbeat_age_s": "write `heartbeat_timeout_s` in the section `safety`",
    "cameras.compression.h264_mbit_s": "write `jpeg_quality`; streams are no longer simulated",
    "detections.latency_s": "write `latency_s` beside `detections`",
    "desired": "write the section `mission`, with `kind: circle_then_tangent` for the same flight",
    "faults.kind": "delete it: a camera that fails sends nothing but noise",
    "faults.sigma": "delete it: a camera that fails sends nothing but noise",
    "stop": "delete it: all `seeds` are flown",
    "safety.degraded_gusts_m_s": "write `degraded_velocity_error_m_s`",
    "safety.gate.max_drift_m_s": "delete it: wind is left to the autopilot",
    "take_off_apart_s": "delete it: simulated drones take off together",
    "safety.gate.response_s": "delete it, and write `reaction_s`, which contains it",
    "safety.max_gusts_m_s": "write `max_velocity_error_m_s`",
    "safety.degraded_ego_motion_failures": "write `degraded_ego_motion_s`, in seconds instead of steps",
    "safety.max_ego_motion_failures": "write `max_ego_motion_s`, in seconds instead of steps",
}
"""By a drone's, scenario's or campaign's key, with dots, and without `drone` before those of a drone in a scenario."""
