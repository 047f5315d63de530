"""The state of each drone of a fleet, from its telemetry."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from flockd.fleet.watcher import Watched, ambiguity

GONE, QUIET = "gone", "quiet"
"""Instead of a state: its process has ended or cannot be reached; it is there, and publishes nothing."""
WORST_FIRST = (GONE, QUIET, "asking", "hover", "silent", "degraded", "idle", "ready", "normal")


def status_rows(drones: Iterable[Watched], now_s: float) -> list[dict[str, Any]]:
    """One row for each drone, as JSON, the worst first: names of several drones, then states; names of none last.

    ``now_s``: on the watcher's clock.
    """
    rows = [(drone.announced or drone.alive, _row(drone, now_s)) for drone in drones]
    return [row for _, row in sorted(rows, key=lambda one: (not one[0], *_worst(one[1])))]


def by_name(name: str) -> tuple[object, ...]:
    """Sorts names as people count: drone2 before drone10."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"([^0-9]*)([0-9]*)", name)], name


def _worst(row: Mapping[str, Any]) -> tuple[object, ...]:
    return (
        len(row["identities"]) < 2, WORST_FIRST.index(row["state"]), by_name(row["fleet"]), by_name(row["drone"]),
    )  # fmt: skip


def _row(drone: Watched, now_s: float) -> dict[str, Any]:
    flight: Mapping[str, Any] = drone.message("flight", now_s) or {}
    computer: Mapping[str, Any] = drone.message("computer", now_s) or {}
    clock: Mapping[str, Any] = drone.message("clock", now_s) or {}
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
        "clock_offset_s": clock.get("offset_s"),
        "clock_error_s": clock.get("error_s"),
        "clock_jitter_s": clock.get("jitter_s"),
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
    """That several operators command it, and what they asked."""
    if len(orders) < 2:
        return None
    told = ", ".join(f"{order['operator']:.80} ({order['command']:.20})" for order in orders)
    return f"{len(orders)} operators commanded it within a minute, the last one first: {told}; agree on one"


def _told(why: str) -> str:
    """What is wrong with a message, and what it may come from."""
    return f"{why}; it may run another version of flockd" if why.endswith("is missing") else why
