"""Operators' commands, and orders to a drone's mission, as messages in queries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flockd.core.messages import MissionOrder
from flockd.core.printable import printable
from flockd.onboard.message_json import from_json, parsed
from flockd.onboard.telemetry.topics import AskMessage, OrderMessage

_OF_GOTO = frozenset({"north_m", "east_m", "latitude_deg", "longitude_deg", "height_m", "speed_m_s"})
_OF_VELOCITY = frozenset({"velocity_ne", "height_m"})
_LONGEST = 4096
LONGEST_NAME = 120
"""Longest name of an operator or a session, characters."""


def parse_ask(payload: bytes) -> AskMessage:
    """The contents of a query for a command. Raises ValueError, with a sentence for its sender, if it is invalid."""
    message = _object(payload)
    try:
        ask: AskMessage = from_json(AskMessage, message)
    except ValueError as error:
        told = f"an order has to say who gives it, its number and its time ({error}); see docs/fleet_page.md"
        raise ValueError(told) from error
    names = ask["operator"], ask["session"]
    if not all(name and len(name) <= LONGEST_NAME and printable(name, lines=False) == name for name in names):
        raise ValueError(
            f"an order's operator and session have to be texts of 1 to {LONGEST_NAME} printable characters"
        )
    return ask


def parse_order(command: str, message: Mapping[str, object] | None) -> MissionOrder:
    """The order of a `goto` or `velocity`.

    Raises ValueError, with a sentence for its sender, if it is invalid; whether it may be flown is not checked here.
    """
    if not isinstance(message, Mapping):
        raise ValueError(f"{command} needs an order, a JSON object")  # noqa: TRY004 - of the message, not of the caller
    allowed = _OF_GOTO if command == "goto" else _OF_VELOCITY
    unknown = sorted(message.keys() - allowed)
    if unknown:
        raise ValueError(f"{command} has no key {unknown[0]!r}; its keys are {', '.join(sorted(allowed))}")
    order: OrderMessage = from_json(OrderMessage, dict(message))
    if None in (*order.values(), *order.get("velocity_ne", ())):
        raise ValueError(f"the values of {command} have to be numbers")
    height_m, speed_m_s = order.get("height_m"), order.get("speed_m_s")
    if command == "velocity":
        velocity = order.get("velocity_ne", [])
        if len(velocity) != 2:
            raise ValueError("velocity needs `velocity_ne`, a list of two numbers in m/s")
        return MissionOrder(velocity=np.array(velocity, np.float64), height_m=height_m)
    metres = [order[key] for key in ("north_m", "east_m") if key in order]
    degrees = [order[key] for key in ("latitude_deg", "longitude_deg") if key in order]
    if sorted((len(metres), len(degrees))) != [0, 2]:
        raise ValueError("goto needs `north_m` and `east_m`, or `latitude_deg` and `longitude_deg`")
    return MissionOrder(
        place=np.array(metres, np.float64) if metres else None,
        place_deg=np.array(degrees, np.float64) if degrees else None,
        height_m=height_m,
        speed_m_s=speed_m_s,
    )


def _object(payload: bytes) -> dict[str, Any]:
    if len(payload) > _LONGEST:
        raise ValueError(f"an order has {_LONGEST} bytes at most")
    try:
        message = parsed(payload)
    except ValueError as error:
        raise ValueError("an order has to be a JSON object") from error
    if not isinstance(message, dict):
        raise ValueError("an order has to be a JSON object")  # noqa: TRY004 - of the message, not of the caller
    return message
