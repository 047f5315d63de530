"""Checks the autopilot: link, firmware, and parameters that make it act when setpoints stop. Changes nothing."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from flockd.core.config import DroneConfig
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.messages import RangeReading
from flockd.flight.safety import link_lost
from flockd.ground.doctor import Finding, failed, failed_from_error, graded, passed, warned
from flockd.onboard.autopilot.autopilot_status import AutopilotError, AutopilotStatus, Firmware
from flockd.onboard.autopilot.clock_sync import ClockEstimate
from flockd.onboard.autopilot.mavlink_messages import MOST_ERROR_S
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.refusals import Refusal

HEARD_S = 10.0
CLOCK_S = 1.0
"""Time for clock exchanges."""
CHECKS_S = 2.0
"""Time for the autopilot to run and report its checks."""
OLDEST_TRIED = (1, 14)
"""Before PX4 1.14, COM_OBL_RC_ACT held only with a remote control, and COM_OBL_ACT without."""
LONGEST_LOSS_S = 1.0

RANGE_FINDER = "range finder"
WATCHED_S = 1.5
"""Time for which its messages are watched."""
LEAST_RATE_HZ = 10.0
NEAREST_M = 0.5
"""Largest permitted shortest range: a sensor with a larger one is blind at take-off and landing."""

PARAMETERS: dict[str, type[int] | type[float]] = {
    "COM_OF_LOSS_T": float,
    "COM_OBL_RC_ACT": int,
    "COM_LOW_BAT_ACT": int,
    "GF_ACTION": int,
    "GF_MAX_HOR_DIST": float,
    "GF_MAX_VER_DIST": float,
    "CP_DIST": float,
}
"""PX4's parameters that are checked, with their types in PX4."""


class ParameterChoice(NamedTuple):
    """A parameter that chooses PX4's action in some case."""

    when: str
    words: Mapping[int, str]
    """PX4's values."""
    good: tuple[int, int, int]
    """Permitted values, the best first."""
    poor: tuple[int, ...] | None = None
    """Values that are a warning; None: all others. Any other value is a failure."""


ACTIONS = {
    "COM_OBL_RC_ACT": ParameterChoice(
        "when setpoints stop",
        {
            -1: "disabled: it flies on with the last velocity",
            0: "Position: the sticks then fly it; with no remote control it returns home",
            1: "Altitude: it keeps its height, and drifts on",
            2: "Stabilized: it keeps level, and drifts on and down",
            3: "Return",
            4: "Land",
            5: "Hold",
            6: "Terminate: the motors stop in the air",
            7: "Disarm: the motors stop in the air",
        },
        (5, 4, 3),
        (0,),
    ),
    "COM_LOW_BAT_ACT": ParameterChoice(
        "when the battery is low",
        {0: "only warns", 1: "Return", 2: "Land", 3: "Return, and Land when nearly empty"},
        (3, 2, 1),
    ),
    "GF_ACTION": ParameterChoice(
        "at PX4's fence",
        {
            0: "None: PX4 has no fence",
            1: "Warning: PX4's fence stops nothing",
            2: "Hold",
            3: "Return",
            4: "Terminate: motors stop at the fence",
            5: "Land",
        },
        (2, 3, 5),
    ),
}


def check_autopilot(config: DroneConfig, heard_s: float = HEARD_S) -> Iterator[Finding]:
    """Runs all checks over a separate link to an autopilot that is heard within ``heard_s``."""
    if config.autopilot is None:
        measured = "the configuration has no `autopilot`: this drone can be simulated but not flown"
        yield warned("autopilot", measured, "add `autopilot` with the `address` of the autopilot")
        return
    yield from asyncio.run(_ask(config, config.autopilot, heard_s))


async def _ask(config: DroneConfig, parameters: AutopilotParameters, heard_s: float) -> list[Finding]:
    link = await AutopilotLink.connect(parameters, timeout_s=heard_s)
    try:
        found = [judge_heartbeat(link.system_id, link.status(), config)]
        if parameters.system_id is None:
            measured = f"autopilot.system_id is not given: the only autopilot heard is used, system {link.system_id}"
            fix = "give each drone of the fleet another MAV_SYS_ID, and write this one's as autopilot.system_id"
            found.append(warned("system id", measured, fix))
        try:
            found.append(judge_firmware(await link.firmware()))
        except AutopilotError as error:
            found.append(failed_from_error("firmware", str(error)))
            if not _is_silent(link.status(), config):
                measured = "it sends, but does not respond: no message reaches it, or it accepts signed ones only"
                fix = "check the cable's other direction; remove the signing key from its SD card"
                return [*found, failed("signing", measured, fix)]
        found += await _parameters(link, config)
        if _is_silent(link.status(), config):
            return found
        with suppress(AutopilotError, TimeoutError):  # without the checks of now, what its messages say counts
            async with asyncio.timeout(CHECKS_S):
                await link.ask_for_checks()
                while not link.knows_checks():
                    await asyncio.sleep(0.02)
        found += judge_refusals(link.refusals())
        with suppress(TimeoutError):
            async with asyncio.timeout(CLOCK_S):
                await link.synchronise()
        found.append(judge_clock(link.received.trusted_clock()))
        if (fault := link.unusable()) is not None:
            found.append(failed_from_error("system id", str(fault)))
        if config.perception.scale == "height" and config.perception.height != "barometer":
            await asyncio.sleep(WATCHED_S)
            found.append(judge_range_finder(link.received.ground_range, tuple(link.received.ranges_s), config))
    finally:
        await link.close()
    return found


async def _parameters(link: AutopilotLink, config: DroneConfig) -> list[Finding]:
    found = []
    for name, kind in PARAMETERS.items():
        try:
            value = await link.parameter(name, kind)
        except AutopilotError as error:
            fix = f"check whether this firmware has {name}, and whether the link loses messages"
            found.append(failed(name, str(error), fix))
            if _is_silent(link.status(), config):
                found.append(judge_heartbeat(link.system_id, link.status(), config))
                break
        else:
            found.append(judge_parameter(name, value, config))
    return found


def _is_silent(status: AutopilotStatus, config: DroneConfig) -> bool:
    return link_lost(status.heartbeat_age_s, status.message_age_s, config.safety) is not None


def judge_heartbeat(system_id: int, status: AutopilotStatus, config: DroneConfig) -> Finding:
    """Whether the autopilot is heard, and disarmed."""
    address = "" if config.autopilot is None else f" at {config.autopilot.address}"
    measured = f"system {system_id}{address}, heard {status.heartbeat_age_s:.1f} s ago"
    if _is_silent(status, config):
        return failed("heartbeat", f"{measured} and not since", "check the cable, its baud rate, and what else uses it")
    if status.armed:
        return warned("heartbeat", f"{measured}, and armed", "disarm it on the ground before you examine it")
    return passed("heartbeat", f"{measured}, disarmed, in flight mode {status.flight_mode}")


def judge_refusals(refusals: Sequence[Refusal]) -> list[Finding]:
    """Whether it could be armed and fly offboard now; else each reason."""
    if not refusals:
        return [passed("arming", "it can be armed and fly offboard")]
    refused = [(f"refuses {refusal.refused}: " if refusal.refused else "", refusal) for refusal in refusals]
    return [failed("arming", f"{start}{refusal.what}", refusal.remedy) for start, refusal in refused]


def judge_clock(clock: ClockEstimate | None) -> Finding:
    """Whether its time stamps can be converted to this computer's clock."""
    if clock is None:
        measured = "it does not answer TIMESYNC, or its stamps contradict it: attitudes count from when they arrive"
        return warned("clock", measured, "update the firmware, and check whether the link loses messages")
    measured = f"known to {1e3 * clock.error_s:.2f} ms; shortest round trip {1e3 * clock.round_trip_s:.1f} ms"
    fix = "raise the link's baud rate, send fewer streams over it, and take load off this computer"
    uncertain = ": so uncertain that attitudes count from when they arrive" if clock.error_s > MOST_ERROR_S else ""
    return graded("clock", f"{measured}{uncertain}", fix, warning=bool(uncertain))


def judge_firmware(firmware: Firmware) -> Finding:
    """Whether flockd knows the modes and failsafes of this firmware."""
    measured = f"{firmware.autopilot} {firmware.version}"
    if firmware.autopilot != "PX4":
        return failed("firmware", f"{measured} has other flight modes and failsafes", "flash PX4")
    if tuple(int(part) for part in firmware.version.split(".")[:2]) < OLDEST_TRIED:
        oldest = ".".join(map(str, OLDEST_TRIED))
        return warned("firmware", f"{measured} is older than {oldest}, whose parameters are known here", "update PX4")
    return passed("firmware", measured)


def judge_parameter(name: str, value: float, config: DroneConfig) -> Finding:
    """Whether the value of one of `PARAMETERS` is safe."""
    gate = config.safety.gate
    match name:
        case "COM_OF_LOSS_T":
            return _judge_loss_time(name, value, config)
        case "GF_MAX_HOR_DIST":
            corners_m = [math.hypot(*corner) for corner in gate.fence_corners_m]
            limits_m = [] if gate.fence_radius_m is None else [gate.fence_radius_m]
            limits_m += [max(corners_m)] if corners_m else []
            return _judge_limit(name, value, min(limits_m, default=None), "fence")
        case "GF_MAX_VER_DIST":
            return _judge_limit(name, value, gate.max_height_m, "max_height_m")
        case "CP_DIST":
            told = f"{value:g}; above 0 PX4 does not fly in Position mode without a sensor of distances"
            return graded(name, told, "set CP_DIST to -1, unless a sensor sends them", warning=value > 0)
    return _judge_action(name, ACTIONS[name], int(value), config)


def _judge_loss_time(name: str, value: float, config: DroneConfig) -> Finding:
    """In seconds."""
    gap_s = AutopilotParameters().max_gap_s if config.autopilot is None else config.autopilot.max_gap_s
    too_short, too_long = value <= gap_s, value > LONGEST_LOSS_S
    told = " without setpoints, then its failsafe"
    if too_short:
        told = f", not above autopilot.max_gap_s {gap_s:g}: PX4 would leave offboard in gaps flockd bridges"
    elif too_long:
        told = ": so long it flies on with the last velocity when setpoints stop"
    fix = f"set {name} to {LONGEST_LOSS_S:g} s"
    return graded(name, f"{value:g} s{told}", fix, failure=too_short, warning=too_long)


def _judge_action(name: str, action: ParameterChoice, value: int, config: DroneConfig) -> Finding:
    measured, good = f"{value} ({action.words.get(value, 'not known')}) {action.when}", value in action.good
    if name == "COM_LOW_BAT_ACT" and not good:
        low = config.safety.on_battery_low
        measured += f": flockd asks for {low} (safety.on_battery_low), and nothing does while it is down"
    best, second, third = (f"{one} ({action.words[one]})" for one in action.good)
    fatal = action.poor is not None and value not in (*action.good, *action.poor)
    return graded(name, measured, f"set {name} to {best}, {second} or {third}", failure=fatal, warning=not good)


def _judge_limit(name: str, value: float, own_m: float | None, what: str) -> Finding:
    """PX4's limit should be a little larger than flockd's, as a second line of defence."""
    outside = "where it must never fly" if own_m is None else f"{1.2 * own_m:.0f} m, a little outside flockd's own"
    if value <= 0:
        return warned(name, f"{value:g}: PX4's fence has no such limit", f"set {name} to {outside}")
    if own_m is not None and value <= own_m:
        measured = f"{value:g} m is not outside flockd's own {what} of {own_m:g} m: PX4 ends the flight first"
        return warned(name, measured, f"set {name} to {outside}, or make safety.gate.{what} smaller")
    own = "flockd has none itself" if own_m is None else f"outside flockd's own {own_m:g} m"
    return passed(name, f"{value:g} m, {own}")


def judge_range_finder(reading: RangeReading | None, arrivals_s: Sequence[float], config: DroneConfig) -> Finding:
    """The newest reading of the range finder that faces down; ``arrivals_s``: arrival times of the last readings."""
    if reading is None:
        blame = failed if config.perception.height == "range_finder" else warned
        fix = "check the sensor, its driver and orientation (downward) in PX4, or write perception.height: barometer"
        return blame(RANGE_FINDER, "the autopilot sends no DISTANCE_SENSOR that faces down", fix)
    least_m, most_m = reading.min_m or 0.0, math.inf if reading.max_m is None else reading.max_m
    span_s = arrivals_s[-1] - arrivals_s[0] if arrivals_s else 0.0
    rate_hz = (len(arrivals_s) - 1) / span_s if span_s > 0.0 else 0.0
    measured = (
        f"faces down, {reading.range_m:.2f} m now, measures from {least_m:.2f} to {most_m:.1f} m, {rate_hz:.0f} times "
        f"a second; the drone may fly at {config.safety.gate.max_height_m:g} m"
    )
    fix = f"let the sensor and this link give it at {LEAST_RATE_HZ:g} Hz or more"
    if most_m < config.safety.gate.max_height_m:
        fix = f"make safety.gate.max_height_m {most_m:.0f} m or less, or take a sensor that measures farther"
    elif least_m > NEAREST_M:
        fix = "take a sensor that measures nearer, or fly higher than that from the start"
    elif rate_hz >= LEAST_RATE_HZ:
        return passed(RANGE_FINDER, measured)
    return warned(RANGE_FINDER, measured, fix)
