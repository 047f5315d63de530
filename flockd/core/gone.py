"""What earlier versions had and this one has not: for each, what to use instead."""

from __future__ import annotations

from collections.abc import Mapping

COMMANDS: Mapping[str, str] = {
    "flockd calibrate rig --by": "fly, and take over what the flight found with `--from-flight RECORDING`",
    "flockd calibrate rig --max-offset": "a flight finds the time offset: `--from-flight RECORDING`",
    "flockd view": "open the recording in Foxglove, or in Rerun after `rerun mcap convert RECORDING.mcap -o X.rrd`",
}
"""By a command, or a command and its option, as they were written on the command line."""

KEYS: Mapping[str, str] = {
    "autopilot.max_heartbeat_age_s": "write `heartbeat_timeout_s` in the section `safety`",
    "desired": "write the section `mission`, with `kind: circle_then_tangent` for the same flight",
    "safety.degraded_gusts_m_s": "write `degraded_velocity_error_m_s`",
    "safety.gate.max_drift_m_s": "delete it: wind is left to the autopilot",
    "safety.gate.response_s": "delete it, and write `reaction_s`, which contains it",
    "safety.max_gusts_m_s": "write `max_velocity_error_m_s`",
    "safety.degraded_ego_motion_failures": "write `degraded_ego_motion_s`, in seconds instead of steps",
    "safety.max_ego_motion_failures": "write `max_ego_motion_s`, in seconds instead of steps",
}
"""By a drone's, scenario's or campaign's key, with dots, and without `drone` before those of a drone in a scenario."""
