"""The topic `/fleet`, a row a drone, and the JSON schemas of what is published as JSON."""

from __future__ import annotations

import types
import typing
from typing import Any

from flockd.fleet.page.drone_rows import Row

_FIELDS = {
    "string": ("drone", "fleet", "state", "why", "flight_mode", "mission", "version"),
    "boolean": ("armed", "in_air"),
    "integer": ("neighbours", "setpoints_missed", "messages_lost"),
    "number": (
        "height_m", "north_m", "east_m", "speed_m_s", "yaw_deg", "battery_share", "load", "temperature_c", "rate_hz",
        "delay_ms", "clock_s",
    ),
}  # fmt: skip
"""What is taken over from the page's rows, by type."""
_PLAIN = {float: "number", int: "integer", bool: "boolean", str: "string"}


def fleet_row(name: str, row: Row) -> Row:
    """One drone's row, named as in the topics; null where something is not known."""
    north_m, east_m = row["position_ne"] or (None, None)
    known = {**row, "drone": name, "why": "; ".join(row["why"]), "north_m": north_m, "east_m": east_m}
    return {field: known[field] for fields in _FIELDS.values() for field in fields}


def fleet_schema() -> dict[str, Any]:
    """The schema of all rows."""
    row = {field: {"type": kind} for kind, fields in _FIELDS.items() for field in fields}
    return _object("Fleet", {"drones": {"type": "array", "items": _object("FleetDrone", row)}})


def json_schema(kind: Any) -> dict[str, Any]:
    """The schema of a message of telemetry, for panels that offer fields by name.

    Foxglove's app knows one type a field: one that may be null has its other type here, and an object whose keys are
    not known in advance has none.
    """
    if typing.is_typeddict(kind):
        return _object(kind.__name__, {name: json_schema(one) for name, one in typing.get_type_hints(kind).items()})
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in {typing.Union, types.UnionType}:
        return json_schema(next(branch for branch in inner if branch is not types.NoneType))
    if origin is list:
        return {"type": "array", "items": json_schema(inner[0])}
    return {"type": _PLAIN[kind]} if kind in _PLAIN else {"type": "object", "properties": {}}


def _object(name: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {"title": f"flockd.{name}", "type": "object", "properties": properties}
