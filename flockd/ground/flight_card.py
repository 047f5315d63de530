"""The card of a flight day from a drone's own configuration: limits, heights, what each fault does, who does what."""

from __future__ import annotations

import math
from collections.abc import Iterator

from flockd.core.config import DroneConfig
from flockd.core.config.mission import describe
from flockd.flight.safety.policy import Reaction, rules

PEOPLE = (
    ("safety pilot of this drone", "arms, takes off, selects offboard; the mode switch under a finger all the time"),
    ("safety pilot", "switches to another mode when the drone goes where nobody expected: flockd is silent at once"),
    ("operator", "watches `flockd status`, says events aloud; sends orders only when the pilots know"),
    ("observer", "watches people, birds and weather; says `stop` when anybody or anything comes near"),
)
REACTIONS = {
    Reaction.NOTE: "goes on, and says so",
    Reaction.DEGRADE: "flies slower",
    Reaction.HOVER: "stands still, then asks PX4 for Hold",
    Reaction.HOLD: "asks PX4 for Hold",
    Reaction.RETURN: "asks PX4 for Return",
    Reaction.LAND: "asks PX4 for Land",
    Reaction.SILENCE: "sends nothing; PX4's own failsafe acts",
}


def card(config: DroneConfig) -> str:
    """Markdown, one page when it is printed; ``config`` is what the drone flies with (`load_real_drone`)."""
    return "\n".join((*_head(config), *_limits(config), *_faults(config), *_people(config), *_steps(config), ""))


def _head(config: DroneConfig) -> Iterator[str]:
    yield f"# Flight-day card: {config.name}"
    yield ""
    yield "| date, place | | wind, light | |"
    yield "|---|---|---|---|"
    yield "| purpose, what is new | | flockd version | |"
    yield ""


def _limits(config: DroneConfig) -> Iterator[str]:
    gate, layer = config.safety.gate, config.safety.first_flight_layer
    fences = [] if gate.fence_radius_m is None else [f"{gate.fence_radius_m:g} m around home"]
    fences += [f"a polygon of {len(gate.fence_corners_m)} corners"] if gate.fence_corners_m else []
    yield "## Limits"
    yield ""
    yield "| what | limit |"
    yield "|---|---|"
    yield f"| first flight | {'no' if layer is None else f'yes: layer {layer}'} |"
    yield f"| mission | {describe(config.mission)} |"
    yield f"| speed wanted; let through | {config.flocking.max_speed_m_s:g}; {gate.max_speed_m_s:g} m/s |"
    yield f"| slower when something is wrong | {gate.degraded_speed_m_s:g} m/s |"
    yield f"| height above home | {gate.min_height_m:g} to {gate.max_height_m:g} m |"
    yield f"| it flies at | {_height(config)} |"
    yield f"| fence | {' and '.join(fences) or 'NONE'} |"
    yield f"| level distance to a neighbour | {gate.min_separation_m:g} m |"
    safety = config.safety
    limits = f"{safety.degraded_velocity_error_m_s:g}; {safety.max_velocity_error_m_s:g} m/s"
    yield f"| velocity off its setpoints: slower; Hold | {limits} |"
    if config.autopilot is not None:
        yield f"| battery counts as low at | {100 * config.autopilot.low_battery_share:.0f} % |"
    alone_s = config.safety.alone_s
    yield f"| alone for so long: Hold | {'never' if alone_s is None else f'{alone_s:g} s'} |"
    yield "| PX4: `COM_OF_LOSS_T`, `COM_OBL_RC_ACT`, fence (by hand) | |"
    yield ""


def _height(config: DroneConfig) -> str:
    height_m = config.mission.height_m
    if height_m is None and config.autopilot is not None:
        height_m = config.autopilot.height_m
    return "the height at which it is handed over" if height_m is None else f"{height_m:g} m above the ground at home"


def _faults(config: DroneConfig) -> Iterator[str]:
    yield "## What each fault does"
    yield ""
    yield "| flockd then | faults, by their names in `flockd status` |"
    yield "|---|---|"
    found: dict[str, list[str]] = {}
    for event, rule in rules(config.safety).items():
        found.setdefault(REACTIONS[rule.reaction], []).append(f"`{event.value}`")
        if math.isfinite(rule.after_s):
            later = f"{REACTIONS[rule.later]} after {rule.after_s:g} s"
            found.setdefault(later, []).append(f"`{event.value}`")
    for does, names in found.items():
        yield f"| {does} | {', '.join(names)} |"
    yield ""


def _people(config: DroneConfig) -> Iterator[str]:
    yield "## Who does what"
    yield ""
    yield "| who | what | name |"
    yield "|---|---|---|"
    for who, what in PEOPLE:
        yield f"| {who} | {what} | |"
    allowed = ", ".join(config.telemetry.commands) or "nothing: only the pilot's switch ends the flight"
    yield f"| over telemetry | may ask for {allowed} | |"
    yield ""


def _steps(config: DroneConfig) -> Iterator[str]:
    yield "## Before and after"
    yield ""
    for step in (
        "`flockd doctor` without FAILURE, WARNINGs understood; ten minutes of `flockd run` on a table",
        "propellers off: offboard selected `normal`; another mode `silent` at once; a camera unplugged `degraded`",
        "words agreed: `take over`, `land now`, `stop`",
        "armed and brought up by the pilot to the height above; then offboard for ten seconds, and back by hand",
        "after landing: disarmed, batteries off, `flockd report recordings`, every event understood",
    ):  # fmt: skip
        yield f"- [ ] {step}"
    yield ""
    yield "May the next step of the plan be flown? Signed:"
