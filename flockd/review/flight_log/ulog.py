"""PX4's ULog files, laid on a flight's time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.messages import BoolArray, FloatArray
from flockd.onboard.recording.reader import Recording
from flockd.review.flight_log.autopilot_log import AutopilotLog, Said, Span
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.ulog_file import PATIENCE_S, UlogContents, read_contents, unusable

SETPOINTS, POSITIONS, STATUS, HOME = "trajectory_setpoint", "vehicle_local_position", "vehicle_status", "home_position"
NEEDED = {
    SETPOINTS: ("velocity[0]", "velocity[1]", "position[2]"),
    POSITIONS: ("vx", "vy", "z"),
    STATUS: ("nav_state", "failsafe"),
}
"""Topics and fields."""
MODES = {
    0: "manual",
    1: "altitude",
    2: "position",
    3: "mission",
    4: "hold",
    5: "return",
    10: "acro",
    12: "descend",
    13: "terminated",
    14: "offboard",
    15: "stabilized",
    17: "take-off",
    18: "land",
    19: "follow",
    20: "precision landing",
    21: "orbit",
}
"""PX4's navigation states, in flockd's words where it has them."""
WARNING = 4
"""Syslog's level, as messages of the log have it."""
BEFORE_S, AFTER_S = 10.0, 20.0
"""How much of the log is shown before and after the flight."""
GRID_S = 0.05
LONGEST_S = 86_400.0
"""Of a log that is laid on a flight."""
LEAST_SHARE = 0.6
"""Least share of the commands' squares that the log's setpoints explain where they are laid on each other."""
LEAST_MOTION_M_S = 0.1
NEARLY = 0.9
FRESH_S = 0.5
"""For how long a setpoint of the log counts."""

Clock = tuple[FloatArray, FloatArray]
"""(n,) times on the drone's computer, and (n,) how far the autopilot's clock was ahead of it then."""


def read_ulog(path: Path, patience_s: float = PATIENCE_S) -> UlogContents:
    """A ULog file. Raises UsageError for what is none, or too damaged, or takes too long, and OSError."""
    ulog = read_contents(path, [*NEEDED, HOME], patience_s)
    for topic, names in NEEDED.items():
        data = ulog.topics.get(topic, {})
        missing = [name for name in ("timestamp", *names) if name not in data or not len(data[name])]
        if missing:
            raise unusable(path, f"holds no {topic}.{missing[0]}")
    return ulog


def system_id(ulog: UlogContents) -> int | None:
    """System id of the autopilot that wrote it; None where it does not say."""
    number = ulog.parameters.get("MAV_SYS_ID")
    return None if number is None else int(number)


def drone_of(
    ulog: UlogContents, path: Path, log: FlightLog, recordings: Sequence[Recording]
) -> tuple[int, Recording | None]:
    """The number of the drone whose autopilot wrote it, and that drone's recording, if it is one of these.

    Of several by `autopilot.system_id`; in a simulated fleet autopilots count from 1 as the drones do. Raises
    UsageError where none of the flight's drones can be it.
    """
    names, number = log.metadata.names, system_id(ulog)
    of_system = {
        recording.config.autopilot.system_id: recording for recording in recordings if recording.config.autopilot
    }
    recording = recordings[0] if len(recordings) == 1 else of_system.get(number)
    if recording is not None and names is not None and recording.drone in names:
        return names.index(recording.drone), recording
    drones = log.command_velocity.shape[1]
    drone = 0 if drones == 1 else -1 if number is None else number - 1
    if not 0 <= drone < drones:
        raise unusable(path, f"is of the autopilot with MAV_SYS_ID {number}, which no drone of this flight has")
    return drone, recording


def autopilot_log(ulog: UlogContents, path: Path, log: FlightLog, drone: int, clock: Clock | None) -> AutopilotLog:
    """What it holds of a drone's flight, on the flight's time.

    Args:
        ulog: of `read_ulog`.
        path: its name is in errors and in the report.
        log: of the flight.
        drone: its number in the log.
        clock: of the autopilot, as the drone's recording holds it; None: the setpoints in both are laid on each other.

    Raises UsageError where it is of another flight.
    """
    if clock is not None and log.metadata.clock_at_start_s is not None:
        placed_by, to_flight = "the autopilot's clock, which the recording holds", _by_clock(clock, log)
    else:
        placed_by, to_flight = "its setpoints, which are those of the flight", _by_setpoints(ulog, path, log, drone)
    end_s = float(log.time_s[-1])
    setpoints, positions, status = (ulog.topics[topic] for topic in NEEDED)
    home_down_m = _home_down_m(ulog)
    asked_s, flown_s, state_s = (to_flight(1e-6 * topic["timestamp"]) for topic in (setpoints, positions, status))
    if flown_s[-1] < 0.0 or flown_s[0] > end_s:
        covers = f"{flown_s[0]:.0f} to {flown_s[-1]:.0f} s of this one's time"
        raise unusable(path, f"is of another flight: it covers {covers}")
    asked, flown, changes = (_around(times, end_s) for times in (asked_s, flown_s, state_s))
    names = [MODES.get(int(state), f"mode {int(state)}") for state in status["nav_state"]]
    failing = ["failsafe" if failing else "" for failing in status["failsafe"]]
    return AutopilotLog(
        source=path.name,
        placed_by=placed_by,
        drone=drone,
        setpoint_time_s=asked_s[asked],
        setpoint_velocity=_columns(setpoints, "velocity[0]", "velocity[1]")[asked],
        setpoint_height_m=home_down_m - _columns(setpoints, "position[2]")[asked, 0],
        flown_time_s=flown_s[flown],
        flown_velocity=_columns(positions, "vx", "vy")[flown],
        flown_height_m=home_down_m - _columns(positions, "z")[flown, 0],
        modes=_spans(state_s[changes], np.array(names)[changes].tolist()),
        failsafes=tuple(span for span in _spans(state_s[changes], np.array(failing)[changes].tolist()) if span.what),
        said=_said(ulog, to_flight, end_s),
    )


def _columns(topic: Mapping[str, Any], *names: str) -> FloatArray:
    return np.column_stack([np.asarray(topic[name], float) for name in names])


def _home_down_m(ulog: UlogContents) -> float:
    """Down from the estimator's origin, at the end; 0 where home was not logged."""
    down = ulog.topics.get(HOME, {}).get("z", ())
    return float(down[-1]) if len(down) and np.isfinite(down[-1]) else 0.0


def _around(times_s: FloatArray, end_s: float) -> BoolArray:
    return np.asarray((times_s > -BEFORE_S) & (times_s < end_s + AFTER_S))


def _spans(times_s: FloatArray, what: Sequence[str]) -> tuple[Span, ...]:
    """Runs of the same; each lasts until the next one."""
    begins = [i for i in range(len(what)) if i == 0 or what[i] != what[i - 1]]
    return tuple(
        Span(float(times_s[begin]), float(times_s[min(end, len(what) - 1)]), what[begin])
        for begin, end in pairwise([*begins, len(what)])
    )


def _said(ulog: UlogContents, to_flight: Callable[[FloatArray], FloatArray], end_s: float) -> tuple[Said, ...]:
    said = [one for one in ulog.texts if one.level <= WARNING]
    times_s = to_flight(np.array([1e-6 * one.time_us for one in said]))
    inside = _around(times_s, end_s)
    return tuple(
        Said(float(time_s), one.text.strip()) for time_s, one, kept in zip(times_s, said, inside, strict=True) if kept
    )


# ------------------------------------------------------------------------------------------------------ its own time


def _by_clock(clock: Clock, log: FlightLog) -> Callable[[FloatArray], FloatArray]:
    """The autopilot's seconds on the flight's time, by the clock that was measured in flight."""
    computer_s, ahead_s = clock
    zero_s = log.metadata.clock_at_start_s or 0.0

    def to_flight(autopilot_s: FloatArray) -> FloatArray:
        return autopilot_s - np.interp(autopilot_s, computer_s + ahead_s, ahead_s) - zero_s

    return to_flight


def _by_setpoints(ulog: UlogContents, path: Path, log: FlightLog, drone: int) -> Callable[[FloatArray], FloatArray]:
    """The same where the clock is not known: the shift at which both records of the commands agree best."""
    setpoints = ulog.topics[SETPOINTS]
    logged_s, logged = 1e-6 * np.asarray(setpoints["timestamp"], float), _columns(setpoints, *NEEDED[SETPOINTS][:2])
    known = np.isfinite(logged).all(axis=1)
    logged_s, logged = logged_s[known], logged[known]
    flown = np.isfinite(log.command_velocity[:, drone]).all(axis=1)
    command_s, command = log.time_s[flown], log.command_velocity[flown, drone]
    refusal = "cannot be laid on the flight's time, as the recording holds no clock of the autopilot and "
    if len(logged_s) < 2 or len(command_s) < 2 or float(np.std(command, axis=0).max()) < LEAST_MOTION_M_S:
        raise unusable(path, f"{refusal}too little was commanded to tell by")
    if not 0.0 <= logged_s[-1] - logged_s[0] <= LONGEST_S:
        raise unusable(path, f"{refusal}its times are damaged: they span more than a day, or run backwards")
    times_s = np.arange(command_s[0], command_s[-1], GRID_S)
    held = command[np.searchsorted(command_s, times_s, side="right") - 1]
    shifts_s = np.arange(logged_s[0] - times_s[-1], logged_s[-1] - times_s[0], GRID_S)
    fits = np.array([_fit(times_s + shift_s, held, logged_s, logged) for shift_s in shifts_s])
    shares, differences = fits.T if len(fits) else np.zeros((2, 1))
    if shares.max() < LEAST_SHARE:
        raise unusable(path, f"{refusal}its setpoints are not those of the flight")
    # Steady flight explains as much at many shifts; of those the one that differs least, as commands change there.
    shift_s = float(shifts_s[np.where(shares > NEARLY * shares.max(), differences, np.inf).argmin()])
    return lambda autopilot_s: autopilot_s - shift_s


def _fit(times_s: FloatArray, held: FloatArray, logged_s: FloatArray, logged: FloatArray) -> tuple[float, float]:
    """Which share of the commands' squares the log's setpoints explain, and their mean square difference.

    Where the log has no setpoint it explains nothing, and does not differ.
    """
    at = np.searchsorted(logged_s, times_s, side="right") - 1
    known = (at >= 0) & (times_s - logged_s[np.maximum(at, 0)] < FRESH_S)
    if not known.any():
        return 0.0, np.inf
    differs = float(np.sum((held - logged[at])[known] ** 2))
    return float(np.sum(held[known] ** 2) - differs) / float(np.sum(held**2)), differs / int(known.sum())
