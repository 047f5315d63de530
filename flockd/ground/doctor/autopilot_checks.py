"""The autopilot: connected, of a known version, and set up to act when setpoints stop. Nothing here changes it."""

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
from flockd.ground.doctor import Finding, Level, failed, failed_from_error, graded, passed, warned
from flockd.onboard.autopilot.autopilot_status import AutopilotError, AutopilotStatus, Firmware
from flockd.onboard.autopilot.clock_sync import ClockEstimate
from flockd.onboard.autopilot.mavlink_messages import FACES_DOWN, MOST_ERROR_S
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.refusals import Refusal

HEARD_S = 10.0
CLOCK_S = 1.0
"""For exchanges of times with it."""
CHECKS_S = 2.0
"""For the autopilot to run its checks and to tell them."""
OLDEST_TRIED = (1, 14)
"""Before PX4 1.14, COM_OBL_RC_ACT held only with a remote control, and COM_OBL_ACT without."""
LONGEST_LOSS_S = 1.0

RANGE_FINDER = "range finder"
WATCHED_S = 1.5
"""How long its messages are watched."""
LEAST_RATE_HZ = 10.0
NEAREST_M = 0.5
"""A sensor that measures nothing nearer is blind at take-off and landing."""
_FACES = {0: "forward", 2: "to the right", 4: "backward", 6: "to the left", 24: "up"}

PARAMETERS: dict[str, type[int] | type[float]] = {
    "COM_OF_LOSS_T": float,
    "COM_OBL_RC_ACT": int,
    "COM_LOW_BAT_ACT": int,
    "GF_ACTION": int,
    "GF_MAX_HOR_DIST": float,
    "GF_MAX_VER_DIST": float,
    "CP_DIST": float,
}
"""Those of PX4 that are judged, each as PX4 declares it."""


class ParameterChoice(NamedTuple):
    """A parameter that says what PX4 does in some case."""

    when: str
    words: Mapping[int, str]
    """PX4's values."""
    good: tuple[int, int, int]
    """Those that a drone may have, the best first."""
    poor: tuple[int, ...] | None = None
    """With which it may fly, but not well; None: all others. With what is neither it must not fly."""


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
    """All of it, over a link of its own, to an autopilot that is heard within ``heard_s``."""
    if config.autopilot is None:
        measured = "the configuration has no `autopilot`: this drone can be simulated but not flown"
        yield warned("autopilot", measured, "add `autopilot` with the `address` of the autopilot")
        return
    yield from asyncio.run(_ask(config, config.autopilot, heard_s))


async def _ask(config: DroneConfig, parameters: AutopilotParameters, heard_s: float) -> list[Finding]:
    link = await AutopilotLink.connect(parameters, timeout_s=heard_s)
    try:
        heard = link.status()
        found = [judge_heartbeat(link.system_id, heard, config), *judge_system_id(link.system_id, parameters)]
        responds = True
        try:
            found.append(judge_firmware(await link.firmware()))
        except AutopilotError as error:
            responds = False
            found.append(failed_from_error("firmware", str(error)))
        signing = judge_signing(responds, silent=_is_silent(link.status(), config))
        found += [signing] if responds or signing.level is Level.FAILURE else []
        found += [] if signing.level is Level.FAILURE else await _parameters(link, config)
        if not _is_silent(link.status(), config):
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
            await asyncio.sleep(WATCHED_S if config.perception.height != "barometer" else 0.0)
            found += judge_range_finder(link.received.ground_range(), link.received.range_finders(), config)
        found += judge_messages(link.received.unknown_values())
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
    """Heard, and at rest."""
    address = "" if config.autopilot is None else f" at {config.autopilot.address}"
    measured = f"system {system_id}{address}, heard {status.heartbeat_age_s:.1f} s ago"
    if _is_silent(status, config):
        return failed("heartbeat", f"{measured} and not since", "check the cable, its baud rate, and what else uses it")
    if status.armed:
        return warned("heartbeat", f"{measured}, and armed", "disarm it on the ground before you examine it")
    return passed("heartbeat", f"{measured}, disarmed, in flight mode {status.flight_mode}")


def judge_system_id(system_id: int, parameters: AutopilotParameters) -> list[Finding]:
    """A warning where any autopilot would do."""
    if parameters.system_id is not None:
        return []
    measured = f"autopilot.system_id is not given: the only autopilot that is heard is flown, now system {system_id}"
    fix = "give each drone of the fleet another MAV_SYS_ID, and write this one's as autopilot.system_id"
    return [warned("system id", measured, fix)]


def judge_signing(responds: bool, *, silent: bool) -> Finding:
    """Whether it accepts messages that are not signed (MAVLink 2): flockd's are not, and others' need not be either."""
    if responds:
        return passed("signing", "it accepts unsigned messages of any sender: keep all others off its link")
    if silent:
        return warned("signing", "not known: it is not heard any more", "repair the link first")
    measured = "it is heard and does not respond: nothing reaches it, or it accepts signed messages only"
    return failed("signing", measured, "check the cable's other direction; remove the signing key from its SD card")


def judge_refusals(refusals: Sequence[Refusal]) -> list[Finding]:
    """Why it could not be armed or fly offboard now."""
    if not refusals:
        return [passed("arming", "its checks let it be armed and fly offboard")]
    refused = [(f"refuses {refusal.refused}: " if refusal.refused else "", refusal) for refusal in refusals]
    return [failed("arming", f"{start}{refusal.what}", refusal.remedy) for start, refusal in refused]


def judge_clock(clock: ClockEstimate | None) -> Finding:
    """Whether its stamps can be placed on this computer's clock."""
    if clock is None:
        measured = "it does not answer TIMESYNC, or its stamps contradict it: attitudes count from when they arrive"
        return warned("clock", measured, "update the firmware, and check whether the link loses messages")
    measured = (
        f"{clock.offset_s:+.4f} s against this computer's, known to {1e3 * clock.error_s:.2f} ms; "
        f"single measurements {1e3 * clock.jitter_s:.2f} ms apart, "
        f"shortest round trip {1e3 * clock.round_trip_s:.1f} ms"
    )
    fix = "raise the link's baud rate, send fewer streams over it, and take load off this computer"
    uncertain = ": so uncertain that attitudes count from when they arrive" if clock.error_s > MOST_ERROR_S else ""
    return graded("clock", f"{measured}{uncertain}", fix, warning=bool(uncertain))


def judge_messages(unknown_values: Mapping[str, int]) -> list[Finding]:
    """A warning where messages had values that flockd does not know."""
    if not unknown_values:
        return []
    values = ", ".join(f"{value} ({count} times)" for value, count in sorted(unknown_values.items()))
    return [warned("messages", f"values that flockd does not know: {values}", "update flockd, or the firmware")]


def judge_firmware(firmware: Firmware) -> Finding:
    """Whether it is one whose modes and failsafes flockd knows."""
    measured = f"{firmware.autopilot} {firmware.version}"
    if firmware.autopilot != "PX4":
        return failed("firmware", f"{measured} has other flight modes and failsafes", "flash PX4")
    if tuple(int(part) for part in firmware.version.split(".")[:2]) < OLDEST_TRIED:
        oldest = ".".join(map(str, OLDEST_TRIED))
        return warned("firmware", f"{measured} is older than {oldest}, whose parameters are known here", "update PX4")
    return passed("firmware", measured)


def judge_parameter(name: str, value: float, config: DroneConfig) -> Finding:
    """One of `PARAMETERS`."""
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
            told = (
                ": PX4 lets nobody fly in Position mode where nothing sends it distances of obstacles"
                if value > 0
                else ""
            )
            return graded(name, f"{value:g}{told}", "set CP_DIST to -1, unless a sensor sends them", warning=value > 0)
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
    """PX4's limit should lie a little outside flockd's own, as a second line."""
    outside = "where it must never fly" if own_m is None else f"{1.2 * own_m:.0f} m, a little outside flockd's own"
    if value <= 0:
        return warned(name, f"{value:g}: PX4's fence has no such limit", f"set {name} to {outside}")
    if own_m is not None and value <= own_m:
        measured = f"{value:g} m is not outside flockd's own {what} of {own_m:g} m: PX4 ends the flight first"
        return warned(name, measured, f"set {name} to {outside}, or make safety.gate.{what} smaller")
    own = "flockd has none itself" if own_m is None else f"outside flockd's own {own_m:g} m"
    return passed(name, f"{value:g} m, {own}")


def judge_range_finder(
    reading: RangeReading | None, arrivals_s: Mapping[int, Sequence[float]], config: DroneConfig
) -> list[Finding]:
    """Findings of a drone that is on the ground; none where the configuration takes the height from elsewhere.

    Args:
        reading: the newest of the sensor that faces down, or the autopilot's own distance to bottom.
        arrivals_s: when the last DISTANCE_SENSOR messages came, by MAV_SENSOR_ORIENTATION.
        config: the drone's.
    """
    perception = config.perception
    if perception.scale != "height" or perception.height == "barometer":
        return []
    blame = failed if perception.height == "range_finder" else warned
    if reading is None:
        if arrivals_s:
            others = ", ".join(_FACES.get(number, f"by MAV_SENSOR_ORIENTATION {number}") for number in arrivals_s)
            fix = "mount it facing down, and set its orientation in PX4 (such as SENS_CM8JL65_R_0) to 25, downward"
            return [blame(RANGE_FINDER, f"no range finder faces down; those that are heard face {others}", fix)]
        fix = "see to the sensor and its driver in PX4, or write perception.height: barometer"
        return [blame(RANGE_FINDER, "the autopilot sends no DISTANCE_SENSOR and no distance to bottom", fix)]
    if reading.vertical:
        measured = f"no DISTANCE_SENSOR; PX4's own distance to bottom is {reading.range_m:.2f} m"
        return [
            warned(RANGE_FINDER, measured, "let PX4 send DISTANCE_SENSOR on this link: it is newer, and has its limits")
        ]
    return [_judge_sensor(reading, arrivals_s.get(FACES_DOWN, ()), config)]


def _judge_sensor(reading: RangeReading, arrivals_s: Sequence[float], config: DroneConfig) -> Finding:
    least_m, most_m = reading.min_m or 0.0, reading.max_m
    limits = f"from {least_m:.2f} m" if most_m is None else f"from {least_m:.2f} to {most_m:.1f} m"
    span_s = arrivals_s[-1] - arrivals_s[0] if arrivals_s else 0.0
    rate_hz = (len(arrivals_s) - 1) / span_s if span_s > 0.0 else 0.0
    measured = f"faces down, {reading.range_m:.2f} m now, measures {limits}, {rate_hz:.0f} times a second"
    gate = config.safety.gate
    if most_m is not None and most_m < gate.max_height_m:
        fix = f"make safety.gate.max_height_m {most_m:.0f} m or less, or take a sensor that measures farther"
        return warned(RANGE_FINDER, f"{measured}; the drone may fly at {gate.max_height_m:g} m", fix)
    if least_m > NEAREST_M:
        fix = "take a sensor that measures nearer, or fly higher than that from the start"
        return warned(RANGE_FINDER, measured, fix)
    fix = f"let the sensor and this link give it at {LEAST_RATE_HZ:g} Hz or more"
    return graded(RANGE_FINDER, measured, fix, warning=rate_hz < LEAST_RATE_HZ)
