"""Rows of the drones for the page and ROS 2: one JSON object for each drone, from its telemetry."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from flockd.core.navigation import degrees_apart, metres_a_degree
from flockd.fleet.watcher import Heard, Watched, ambiguity
from flockd.onboard.telemetry.topics import AboutMessage, is_name

GONE, QUIET = "gone", "quiet"
"""Shown instead of a state if the drone's process has ended or cannot be reached, or publishes nothing."""
WORST_FIRST = (GONE, QUIET, "asking", "hover", "silent", "degraded", "idle", "ready", "normal")


def status_rows(drones: Iterable[Watched], now_s: float) -> list[dict[str, Any]]:
    """One JSON row for each drone, the worst first: names that several drones share, then by state; names without a
    drone last.

    ``now_s``: on the watcher's clock.
    """
    rows = [(drone.announced or drone.alive, _status_row(drone, now_s)) for drone in drones]
    return [row for _, row in sorted(rows, key=lambda one: (not one[0], *_worst(one[1])))]


def by_name(name: str) -> tuple[object, ...]:
    """Sorts names as people count: drone2 before drone10."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"([^0-9]*)([0-9]*)", name)], name


def _worst(row: Mapping[str, Any]) -> tuple[object, ...]:
    return (
        len(row["identities"]) < 2, WORST_FIRST.index(row["state"]), by_name(row["fleet"]), by_name(row["drone"]),
    )  # fmt: skip


def _status_row(drone: Watched, now_s: float) -> dict[str, Any]:
    flight: Mapping[str, Any] = drone.message("flight", now_s) or {}
    computer: Mapping[str, Any] = drone.message("computer", now_s) or {}
    neighbours = drone.message("neighbours", now_s)
    state = flight.get("state", QUIET) if drone.alive else GONE
    starting = drone.alive and not drone.topics and not drone.malformed
    malformed = [f"its message `{topic}` is malformed: {_told(why)}" for topic, why in sorted(drone.malformed.items())]
    blind = [camera["fault"] for camera in computer.get("cameras", {}).values() if camera["fault"]]
    orders = flight.get("orders") or []
    return {
        "fleet": drone.fleet,
        "drone": drone.drone,
        "identities": sorted(drone.identities),
        "state": state if state in WORST_FIRST else QUIET,
        "flight_mode": flight.get("flight_mode"),
        "height_m": flight.get("height_m"),
        "battery_share": flight.get("battery_share"),
        "neighbours": None
        if neighbours is None
        else sum(1 for neighbour in neighbours["neighbours"] if neighbour["confirmed"]),
        "load": computer.get("load"),
        "mission": (drone.message("mission", now_s) or {}).get("sentence"),
        "orders": orders,
        "orders_refused": flight.get("orders_refused"),
        "matters": [sentence for sentence in (ambiguity(drone), _operators(orders)) if sentence]
        + malformed
        + (["it has published nothing yet: it starts, or loads its networks"] if starting else [])
        + [reason["sentence"] for reason in flight.get("reasons", ())]
        + blind,
    }


def _operators(orders: list[dict[str, Any]]) -> str | None:
    """A sentence if several operators command the drone, with their orders."""
    if len(orders) < 2:
        return None
    told = ", ".join(f"{order['operator']:.80} ({order['command']:.20})" for order in orders)
    return f"{len(orders)} operators commanded it within a minute, the last one first: {told}; agree on one"


def _told(why: str) -> str:
    """The fault of a message, and its likely cause."""
    return f"{why}; it may run another version of flockd" if why.endswith("is missing") else why


Row = dict[str, Any]
HISTORY_COLUMNS = (
    "time", "north", "east", "height", "speed", "battery", "load", "temperature", "rate", "delay", "clock",
)  # fmt: skip
"""Columns of a drone's history: seconds, metres from the map's origin, metres, m/s, shares, degrees Celsius, steps a
second, milliseconds, seconds."""
MAX_CORNERS = 200
"""Largest number of corners of a drawn fence."""
MAX_CAMERAS = 16
"""Largest number of cameras of one drone with pictures."""
_FARTHEST_M = 1e6


@dataclass(frozen=True)
class Known:
    """Replies of a drone to queries."""

    about: AboutMessage | None = None
    delay_s: float | None = None
    """Round-trip delay of the link."""
    clock_s: float | None = None
    """The drone's wall clock minus this computer's."""


def drone_rows(drones: Iterable[Watched], known: Mapping[str, Known], now_s: float) -> dict[str, Row]:
    """A row for each drone by its key `fleet/drone`, the worst first; ``now_s`` on the watcher's clock."""
    watched = {f"{drone.fleet}/{drone.drone}": drone for drone in drones}
    rows = {}
    origin: tuple[float, float] | None = None
    for status in status_rows(watched.values(), now_s):
        key = f"{status['fleet']}/{status['drone']}"
        rows[key] = _row(watched[key], status, known.get(key, Known()), now_s)
    for key in sorted(rows):  # the map's origin is always the same drone's home
        origin = origin or rows[key]["home_deg"]
    for row in rows.values():
        row["home_ne"] = _offset(origin, row["home_deg"])
        row["origin_ne"] = _sum(row["home_ne"], row["origin_ne"])
    return rows


def history_row(row: Row, time_s: float) -> list[float | None]:
    """The values of a row for trails and curves: `HISTORY_COLUMNS`."""
    north, east = row["position_ne"] or (None, None)
    home = row["home_ne"] or (0.0, 0.0)
    if north is not None and east is not None:
        north, east = round(north + home[0], 2), round(east + home[1], 2)
    return [
        round(time_s, 2), north, east, row["height_m"], row["speed_m_s"], row["battery_share"], row["load"],
        row["temperature_c"], row["rate_hz"], row["delay_ms"], row["clock_s"],
    ]  # fmt: skip


def _row(drone: Watched, status: Mapping[str, Any], known: Known, now_s: float) -> Row:
    """A row; unknown and outdated values are null."""

    def of(topic: str) -> Mapping[str, Any]:
        return drone.message(topic, now_s) or {}

    state, flight, computer = of("state"), of("flight"), of("computer")
    about = known.about
    configuration = {} if about is None else about["configuration"]
    height_m, level = status["height_m"], _vector(state.get("velocity_ned"), 3)
    return {
        **status,
        "height_m": _rounded(state.get("height_m") if height_m is None else height_m, 2),
        "why": [*_silence(drone, status["state"], now_s), *status["matters"]],
        "armed": flight.get("armed"),
        "in_air": flight.get("in_air"),
        "silence": flight.get("silence"),
        **{f"{angle}_deg": _rounded(state.get(f"{angle}_deg"), 1) for angle in ("roll", "pitch", "yaw")},
        "velocity_ned": _vector(state.get("velocity_ned"), size=3),
        "speed_m_s": None if level is None else round(math.hypot(*level), 2),
        "command_ne": _vector(of("command").get("velocity_ne")),
        "position_ne": _vector(state.get("position_ne")),
        "home_deg": _vector(state.get("home_deg"), 7),
        "goal_ne": _vector(of("mission").get("goal_ne")),
        "goal_height_m": _rounded(of("mission").get("goal_height_m"), 2),
        "sees": [_seen(one) for one in of("neighbours").get("neighbours", ())],
        "obstacles_m": of("obstacles").get("range_m"),
        "rate_hz": _rate(drone.topics.get("state"), now_s),
        "load": _rounded(status["load"], 3),
        "temperature_c": _rounded(computer.get("temperature_c"), 1),
        "setpoints_missed": flight.get("setpoints_missed"),
        "messages_lost": computer.get("messages_lost"),
        "recording": computer.get("recording"),
        "delay_ms": None if known.delay_s is None else _rounded(1e3 * known.delay_s, 1),
        "clock_s": _rounded(known.clock_s, 3),
        "cameras": _cameras(drone, computer, configuration),
        "version": None if about is None else about["version"],
        "commands": None if about is None else about["commands"],
        "fence": _fence(configuration),
        "origin_ne": origin_of(configuration),
    }


def _silence(drone: Watched, state: str, now_s: float) -> list[str]:
    """Why no messages of a drone arrive."""
    if state not in {GONE, QUIET}:
        return []
    last_s = max((heard.time_s for heard in drone.topics.values()), default=None)
    since = "" if last_s is None else f"; its last message came {_ago(now_s - last_s)} ago"
    if state == GONE:
        return [f"its process has ended or cannot be reached{since}"]
    return [f"it can be reached and publishes nothing new{since}"] if since else []  # its status says that it starts


def _ago(seconds: float) -> str:
    """A coarse age, so that a row seldom changes."""
    if seconds < 10:
        return "a few seconds"
    return f"{10 * int(seconds // 10)} s" if seconds < 120 else f"{int(seconds // 60)} min"


def _rate(heard: Heard | None, now_s: float) -> float | None:
    """New messages per second; None: they have ceased."""
    if heard is None or not heard.period_s or heard.new_s is None:
        return None
    return None if now_s - heard.new_s > max(3.0 * heard.period_s, 1.5) else round(1.0 / heard.period_s, 2)


def _seen(neighbour: Mapping[str, Any]) -> Row:
    """A neighbour, metres north, east and down from its observer."""
    return {
        "track": neighbour["track"],
        "ned": _vector(neighbour["position_ned"], size=3),
        "sigma_m": _rounded(neighbour["position_sigma_m"], 2),
        "confirmed": neighbour["confirmed"],
        "unseen_s": _rounded(neighbour["unseen_s"], 1),
    }


def _cameras(drone: Watched, computer: Mapping[str, Any], configuration: Mapping[str, Any]) -> dict[str, str | None]:
    """The faults of all cameras whose pictures can be queried.

    A simulated drone publishes no camera status: all cameras of its rig count.
    """
    found = [(name, camera["fault"]) for name, camera in computer.get("cameras", {}).items()]
    rig = configuration.get("rig")
    if "computer" not in drone.topics and isinstance(rig, Mapping) and isinstance(rig.get("cameras"), list):
        found = [(camera.get("name"), None) for camera in rig["cameras"] if isinstance(camera, Mapping)]
    return dict([(name, fault) for name, fault in found if isinstance(name, str) and is_name(name)][:MAX_CAMERAS])


def _vector(values: object, digits: int = 2, *, size: int = 2) -> list[float] | None:
    """The first numbers of a peer's list; None: one of them is missing."""
    if not isinstance(values, list) or len(values) < size:
        return None
    first = values[:size]
    if not all(isinstance(value, int | float) and abs(value) <= _FARTHEST_M for value in first):  # false for NaN too
        return None
    return [round(float(value), digits) for value in first]


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _offset(origin: list[float] | tuple[float, float] | None, home_deg: list[float] | None) -> list[float] | None:
    """(2,) metres from the map's origin to a drone's home; None: home is not known."""
    if origin is None or home_deg is None:
        return None
    north_m, east_m = metres_a_degree(origin[0])
    return [
        round((home_deg[0] - origin[0]) * north_m, 2),
        round(degrees_apart(home_deg[1], origin[1]) * east_m, 2),
    ]


def origin_of(configuration: Mapping[str, Any]) -> list[float] | None:
    """(2,) metres from a drone's home to its mission's origin; None for a malformed one."""
    return _vector(_section(configuration, "mission").get("origin_m"))


def _section(configuration: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = configuration.get(name)
    return section if isinstance(section, dict) else {}


def _sum(one: list[float] | None, other: list[float] | None) -> list[float] | None:
    return None if one is None or other is None else [round(a + b, 2) for a, b in zip(one, other, strict=True)]


def _fence(configuration: Mapping[str, Any]) -> Row | None:
    """The fence around the drone's home, from the configuration that the drone sent; None: it has no valid fence."""
    gate = _section(configuration, "safety").get("gate")
    if not isinstance(gate, dict):
        return None
    radius, corners = gate.get("fence_radius_m"), gate.get("fence_corners_m")
    known = [_vector(corner) for corner in corners[:MAX_CORNERS]] if isinstance(corners, list) else []
    return {
        "radius_m": radius if isinstance(radius, int | float) and 0 < radius <= _FARTHEST_M else None,
        "corners_m": [corner for corner in known if corner is not None],
    }
