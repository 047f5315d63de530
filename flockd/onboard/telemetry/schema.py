"""Whether a peer's message is what the table of topics says: checked where it enters."""

from __future__ import annotations

import functools
import math
import types
import typing
from typing import Any

LARGEST_INT = 2**53
"""The largest that a browser counts exactly."""
LARGEST_NUMBER = 1e10
"""Far beyond every clock and measure, and small enough for a watcher to calculate with it."""
LARGEST_OF_UNIT = {"_deg": 360.0, "_m": 1e6, "_ne": 1e6, "_ned": 1e6, "_m_s": 1e6}
"""By the end of a field's name: no drone is, sees or flies farther or faster."""
LONGEST_TEXT = 4096
"""Characters; a path may have as many."""
MOST_ITEMS = 1000
"""Of a list or an object."""


def fault(message: object, kind: type) -> str | None:
    """What is wrong with a message that should be of this TypedDict: a key and a few words; None if nothing is.

    Further keys, as of a later version, are no fault. A number that was not finite is null, which only the message's
    own time may not be. Numbers, texts, lists and objects have bounds.
    """
    found = _fault("", message, kind)
    if found is None and "time_s" in _fields(kind) and isinstance(message, dict) and message["time_s"] is None:
        return "time_s is null"
    return found


def completed(value: Any, kind: Any) -> Any:
    """A message of a drone of an earlier version, with null for each key that it lacks and that may be null.

    ``kind``: the TypedDict that it should be of. What is of another kind stays as it is, for `fault` to find.
    """
    if typing.is_typeddict(kind) and isinstance(value, dict):
        fields = _fields(kind)
        known = {name: completed(one, fields[name]) if name in fields else one for name, one in value.items()}
        return {**{name: None for name, of_field in fields.items() if _may_be_null(of_field)}, **known}
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is list and typing.is_typeddict(inner[0]) and isinstance(value, list):
        return [completed(one, inner[0]) for one in value]
    if origin is dict and typing.is_typeddict(inner[1]) and isinstance(value, dict):
        return {name: completed(one, inner[1]) for name, one in value.items()}
    return value


def _may_be_null(kind: Any) -> bool:
    return types.NoneType in typing.get_args(kind)


@functools.cache
def _fields(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _fault(key: str, value: object, kind: Any) -> str | None:
    if typing.is_typeddict(kind):
        return _fault_of_section(key, value, kind)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in {typing.Union, types.UnionType}:
        branches = [branch for branch in inner if branch is not types.NoneType]
        return None if value is None else _fault(key, value, branches[0])
    if origin in {list, dict} and isinstance(value, list | dict) and len(value) > MOST_ITEMS:
        return f"{key} has more than {MOST_ITEMS} entries"
    if origin is list:
        if not isinstance(value, list):
            return f"{key} is no list"
        if inner[0] is float:
            largest = _largest(key)
            if all(type(one) is float and abs(one) <= largest for one in value if one is not None):
                return None  # as nearly all are, and long ones cost a tenth so
        return next((found for i, one in enumerate(value) if (found := _fault(f"{key}[{i}]", one, inner[0]))), None)
    if origin is dict:
        if not isinstance(value, dict):
            return f"{key} is no object"
        if not all(_is_text(name) for name in value):
            return f"{key} has a name that is no text"
        return next((found for name, one in value.items() if (found := _fault(f"{key}.{name}", one, inner[1]))), None)
    if kind is float and isinstance(value, int | float) and _largest(key) < abs(value) < math.inf:
        return f"{key} is beyond {_largest(key):g}"
    return None if _is_a(value, kind) else f"{key} is no {_WORDS.get(kind, 'JSON value')}"


def _largest(key: str) -> float:
    """Of a number, by its field's name."""
    name = key.partition("[")[0]
    return next((most for unit, most in LARGEST_OF_UNIT.items() if name.endswith(unit)), LARGEST_NUMBER)


def _fault_of_section(key: str, value: object, kind: type) -> str | None:
    if not isinstance(value, dict):
        return f"{key or 'it'} is no object"
    for name, of_field in _fields(kind).items():
        path = f"{key}.{name}" if key else name
        found = _fault(path, value[name], of_field) if name in value else f"{path} is missing"
        if found:
            return found
    return None


_WORDS: dict[Any, str] = {float: "finite number", int: "whole number", bool: "true or false", str: "text"}


def _is_a(value: object, kind: Any) -> bool:
    if kind in {float, int} and isinstance(value, bool):
        return False
    if kind is float:
        return value is None or (isinstance(value, float) and math.isfinite(value)) or _is_a(value, int)
    if kind is int:
        return isinstance(value, int) and abs(value) <= LARGEST_INT
    return kind is object or (isinstance(value, kind) and (kind is not str or _is_text(value)))


def _is_text(value: str) -> bool:
    """One that can be written as UTF-8, which half a surrogate pair cannot, and is not endless."""
    try:
        return len(value) <= LONGEST_TEXT and (value.isascii() or bool(value.encode()))
    except UnicodeEncodeError:
        return False
