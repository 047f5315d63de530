"""The card of a flight day from a drone's configuration: limits, reactions to faults, roles of people, a checklist."""

from __future__ import annotations

import math

from flockd.core.config import DroneConfig
from flockd.core.config.mission import describe
from flockd.core.secrets import masked
from flockd.flight.safety.policy import Reaction, rules

REACTIONS = {
    Reaction.NOTE: "goes on, and says so",
    Reaction.DEGRADE: "flies slower",
    Reaction.HOVER: "stands still, then asks PX4 for Hold",
    Reaction.HOLD: "asks PX4 for Hold",
    Reaction.RETURN: "asks PX4 for Return",
    Reaction.LAND: "asks PX4 for Land",
    Reaction.SILENCE: "sends nothing; PX4's own failsafe acts",
}
TEXT = """\
# Flight-day card: {name}

| date, place | | wind, light | |
|---|---|---|---|
| purpose, what is new | | flockd version | |

## Limits

| what | limit |
|---|---|
{limits}
| PX4: `COM_OF_LOSS_T`, `COM_OBL_RC_ACT`, fence (by hand) | |

## What each fault does

| flockd then | faults, by their names in `flockd status` |
|---|---|
{faults}

## Who does what

| who | what | name |
|---|---|---|
| safety pilot of this drone | arms, takes off, selects offboard; the mode switch under a finger all the time | |
| safety pilot | switches to another mode when the drone goes where nobody expected: flockd is silent at once | |
| operator | watches `flockd status`, says events aloud; sends orders only when the pilots know | |
| observer | watches people, birds and weather; says `stop` when anybody or anything comes near | |
| over telemetry | may ask for {allowed} | |

## Before and after

- [ ] `flockd doctor` without FAILURE, WARNINGs understood; ten minutes of `flockd run` on a table
- [ ] propellers off: offboard selected `normal`; another mode `silent` at once; a camera unplugged `degraded`
- [ ] words agreed: `take over`, `land now`, `stop`
- [ ] armed and brought up by the pilot to the height above; then offboard for ten seconds, and back by hand
- [ ] after landing: disarmed, batteries off, `flockd report recordings`, every event understood

May the next step of the plan be flown? Signed:
"""


def card(config: DroneConfig) -> str:
    """Markdown, one page when it is printed; ``config`` is what the drone flies with (`load_real_drone`)."""
    return TEXT.format(
        name=config.name,
        limits="\n".join(f"| {what} | {limit} |" for what, limit in _limits(config).items()),
        faults="\n".join(f"| {does} | {', '.join(names)} |" for does, names in _faults(config).items()),
        allowed=", ".join(config.telemetry.commands) or "nothing: only the pilot's switch ends the flight",
    )


def _limits(config: DroneConfig) -> dict[str, str]:
    safety, gate, autopilot = config.safety, config.safety.gate, config.autopilot
    fences = [] if gate.fence_radius_m is None else [f"{gate.fence_radius_m:g} m around home"]
    fences += [f"a polygon of {len(gate.fence_corners_m)} corners"] if gate.fence_corners_m else []
    by_image: dict[str, list[str]] = {}
    for camera in () if config.source is None else config.source.cameras:
        by_image.setdefault(masked(camera.place), []).append(camera.name)
    shared = [f"{', '.join(names)}: all of {place}" for place, names in by_image.items() if len(names) > 1]
    own_m = config.mission.height_m
    height_m = own_m if own_m is not None or autopilot is None else autopilot.height_m
    off = f"{safety.degraded_velocity_error_m_s:g}; {safety.max_velocity_error_m_s:g} m/s"
    return {
        "first flight": "no" if safety.first_flight_layer is None else f"yes: layer {safety.first_flight_layer}",
        "mission": describe(config.mission),
        "speed wanted; let through": f"{config.flocking.max_speed_m_s:g}; {gate.max_speed_m_s:g} m/s",
        "slower when something is wrong": f"{gate.degraded_speed_m_s:g} m/s",
        "height above home": f"{gate.min_height_m:g} to {gate.max_height_m:g} m",
        "it flies at": (
            "the height at which it is handed over" if height_m is None else f"{height_m:g} m above the ground at home"
        ),
        "fence": " and ".join(fences) or "NONE",
        "level distance to a neighbour": f"{gate.min_separation_m:g} m",
        "velocity off its setpoints: slower; Hold": off,
        **({"cameras that fail together": "; ".join(shared)} if shared else {}),
        **({} if autopilot is None else {"battery counts as low at": f"{100 * autopilot.low_battery_share:.0f} %"}),
        "alone for so long: Hold": "never" if safety.alone_s is None else f"{safety.alone_s:g} s",
    }


def _faults(config: DroneConfig) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for event, rule in rules(config.safety).items():
        found.setdefault(REACTIONS[rule.reaction], []).append(f"`{event.value}`")
        if math.isfinite(rule.after_s):
            later = f"{REACTIONS[rule.later]} after {rule.after_s:g} s"
            found.setdefault(later, []).append(f"`{event.value}`")
    return found
