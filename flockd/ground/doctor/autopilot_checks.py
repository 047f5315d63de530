"""The autopilot: connected, of a known version, and set up to act when setpoints stop. Nothing here changes it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from flockd.core.config import DroneConfig
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.safety import GateParameters
from flockd.flight.safety import link_lost
from flockd.ground.doctor.finding import Finding, Level, failed, failed_from_error, passed, warned
from flockd.ground.doctor.range_checks import WATCHED_S, judge_range_finder
from flockd.onboard.autopilot.autopilot_status import AutopilotError, AutopilotStatus, Firmware
from flockd.onboard.autopilot.clock_sync import ClockEstimate
from flockd.onboard.autopilot.mavlink_messages import MOST_ERROR_S
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
            found += judge_refusals(await _refusals(link))
            found.append(judge_clock(await _clock(link)))
            found += await _range_finder(link, config)
        found += judge_messages(link.unknown_values())
    finally:
        await link.close()
    return found


async def _refusals(link: AutopilotLink) -> tuple[Refusal, ...]:
    """What the autopilot's checks say when they are run now; without such a list, what its messages say."""
    try:
        async with asyncio.timeout(CHECKS_S):
            await link.ask_for_checks()
            while not link.knows_checks():
                await asyncio.sleep(0.02)
    except (AutopilotError, TimeoutError):
        pass
    return link.refusals()


async def _clock(link: AutopilotLink) -> ClockEstimate | None:
    """The autopilot's clock after some exchanges; None where it does not answer them."""
    with suppress(TimeoutError):
        async with asyncio.timeout(CLOCK_S):
            await link.synchronise()
    return link.clock()


async def _range_finder(link: AutopilotLink, config: DroneConfig) -> list[Finding]:
    await asyncio.sleep(WATCHED_S if config.perception.height != "barometer" else 0.0)
    return judge_range_finder(link.ground_range(), link.range_finders(), config)


async def _parameters(link: AutopilotLink, config: DroneConfig) -> list[Finding]:
    found = []
    for name, wanted in PARAMETERS.items():
        try:
            value = await link.parameter(name, wanted.kind)
        except AutopilotError as error:
            fix = f"check whether this firmware has {name}, and whether the link loses messages"
            found.append(failed(name, str(error), fix))
            if _is_silent(link.status(), config):
                found.append(judge_heartbeat(link.system_id, link.status(), config))
                break
        else:
            found.append(wanted.judge(value, config))
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
    if clock.error_s > MOST_ERROR_S:
        return warned("clock", f"{measured}: so uncertain that attitudes count from when they arrive", fix)
    return passed("clock", measured)


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


def judge_loss_time(value: float, config: DroneConfig) -> Finding:
    """COM_OF_LOSS_T, in seconds."""
    name, measured = "COM_OF_LOSS_T", f"{value:g} s"
    gap_s = AutopilotParameters().max_gap_s if config.autopilot is None else config.autopilot.max_gap_s
    fix = f"set {name} to {LONGEST_LOSS_S:g} s"
    if value <= gap_s:
        measured = (
            f"{measured}, not above autopilot.max_gap_s {gap_s:g}: PX4 would leave offboard in gaps flockd bridges"
        )
        return failed(name, measured, fix)
    if value > LONGEST_LOSS_S:
        return warned(name, f"{measured}: so long it flies on with the last velocity when setpoints stop", fix)
    return passed(name, f"{measured} without setpoints, then its failsafe")


def judge_loss_action(value: int, config: DroneConfig) -> Finding:
    """COM_OBL_RC_ACT: what it does when setpoints stop."""
    what = {
        -1: "disabled: it flies on with the last velocity",
        0: "Position: the sticks then fly it; with no remote control it returns home",
        1: "Altitude: it keeps its height, and drifts on",
        2: "Stabilized: it keeps level, and drifts on and down",
        3: "Return",
        4: "Land",
        5: "Hold",
        6: "Terminate: the motors stop in the air",
        7: "Disarm: the motors stop in the air",
    }
    blame = warned if value == 0 else failed
    return _judge_action("COM_OBL_RC_ACT", value, what, "when setpoints stop", (5, 4, 3), blame)


def judge_low_battery(value: int, config: DroneConfig) -> Finding:
    """COM_LOW_BAT_ACT."""
    what = {0: "only warns", 1: "Return", 2: "Land", 3: "Return, and Land when nearly empty"}
    low = config.safety.on_battery_low
    own = f": flockd asks for {low} (safety.on_battery_low), and nothing does while it is down"
    when = f"when the battery is low{'' if value in {1, 2, 3} else own}"
    return _judge_action("COM_LOW_BAT_ACT", value, what, when, (3, 2, 1), warned)


def judge_fence_action(value: int, config: DroneConfig) -> Finding:
    """GF_ACTION."""
    what = {
        0: "None: PX4 has no fence",
        1: "Warning: PX4's fence stops nothing",
        2: "Hold",
        3: "Return",
        4: "Terminate: motors stop at the fence",
        5: "Land",
    }
    return _judge_action("GF_ACTION", value, what, "at PX4's fence", (2, 3, 5), warned)


def _judge_action(
    name: str,
    value: int,
    what: Mapping[int, str],
    when: str,
    good: Sequence[int],
    blame: Callable[[str, str, str], Finding],
) -> Finding:
    """``what``: PX4's values in words; ``good``: those that a drone may have, the best first."""
    measured = f"{value} ({what.get(value, 'not known')}) {when}"
    best, second, third = (f"{one} ({what[one]})" for one in good)
    return (
        passed(name, measured) if value in good else blame(name, measured, f"set {name} to {best}, {second} or {third}")
    )


def judge_fence_radius(value: float, config: DroneConfig) -> Finding:
    """GF_MAX_HOR_DIST, in metres."""
    return _judge_limit("GF_MAX_HOR_DIST", value, _reach_m(config.safety.gate), "fence")


def judge_fence_height(value: float, config: DroneConfig) -> Finding:
    """GF_MAX_VER_DIST, in metres."""
    return _judge_limit("GF_MAX_VER_DIST", value, config.safety.gate.max_height_m, "max_height_m")


def judge_collision_prevention(value: float, config: DroneConfig) -> Finding:
    """CP_DIST, in metres."""
    name, sends = "CP_DIST", config.autopilot is not None and config.autopilot.obstacle_distance
    if value > 0 and sends:
        return passed(
            name, f"{value:g} m: PX4 stops a pilot in Position mode by what flockd sees, and where it does not"
        )
    if value > 0:
        measured = f"{value:g} m: PX4 lets nobody fly in Position mode where nothing sends it distances of obstacles"
        return warned(name, measured, "set CP_DIST to -1, or autopilot.obstacle_distance to true")
    if sends:
        measured = f"{value:g}: PX4 ignores the distances that autopilot.obstacle_distance sends"
        return warned(name, measured, "set CP_DIST to the distance to keep, in metres")
    return passed(name, f"{value:g}: PX4 stops no pilot before obstacles")


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


def _reach_m(gate: GateParameters) -> float | None:
    """How far from home flockd's own fence lets it fly; None: for ever."""
    corners = [(north**2 + east**2) ** 0.5 for north, east in gate.fence_corners_m]
    limits = [max(corners)] if corners else []
    return min([*limits, *([] if gate.fence_radius_m is None else [gate.fence_radius_m])], default=None)


@dataclass(frozen=True)
class Parameter:
    """One of PX4's that is judged."""

    kind: type[int] | type[float]
    """As PX4 declares it."""
    judge: Callable[..., Finding]
    """Takes the value and the drone's configuration."""


PARAMETERS = {
    "COM_OF_LOSS_T": Parameter(float, judge_loss_time),
    "COM_OBL_RC_ACT": Parameter(int, judge_loss_action),
    "COM_LOW_BAT_ACT": Parameter(int, judge_low_battery),
    "GF_ACTION": Parameter(int, judge_fence_action),
    "GF_MAX_HOR_DIST": Parameter(float, judge_fence_radius),
    "GF_MAX_VER_DIST": Parameter(float, judge_fence_height),
    "CP_DIST": Parameter(float, judge_collision_prevention),
}
