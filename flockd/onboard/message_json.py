"""Messages to JSON and back, their checks, and the JSON schema of each, all derived from their types.

Dataclasses are recorded without loss: a number has as many digits as restore it exactly; one that is not finite is the
text `NaN`, `Infinity` or `-Infinity`, which JSON's own grammar lacks; a field that is None is left out. An array with a
`Shape` in its annotation is a flat list of numbers, row by row, as viewers do not take lists of lists. A `Reason` is
its text. TypedDicts are telemetry, which peers send: every number is finite or null, and numbers, texts, lists and
objects have limits.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import types
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np

from flockd.core.messages import Reason, ReasonKind, Shape

Json = Any
"""The types that `json` writes and reads: text, numbers, booleans, lists, and mappings by text."""

LARGEST_INT = 2**53
"""The largest integer that browsers represent exactly."""
LARGEST_NUMBER = 1e10
"""Larger than every clock and measurement, and small enough for a watcher's arithmetic."""
LARGEST_OF_UNIT = {"_deg": 360.0, "_m": 1e6, "_ne": 1e6, "_ned": 1e6, "_m_s": 1e6}
"""Limits by the end of a field's name: no drone is, sees or flies farther or faster."""
LONGEST_TEXT = 4096
"""Characters; a path may have as many."""
MOST_ITEMS = 1000
"""Largest number of entries of a list or an object."""
_NAMES: Mapping[Any, str] = {float: "finite number", int: "whole number", bool: "true or false", str: "text"}
_SCHEMAS = {float: "number", int: "integer", bool: "boolean", str: "string"}


def parsed(data: bytes) -> Json:
    """Parses JSON from outside. Raises ValueError if it is not JSON, or nested too deep."""
    try:
        return json.loads(data)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error


def to_json(value: object) -> Json:
    """A message to be recorded, or any value in one. Raises TypeError for a type that no message has."""
    if isinstance(value, Reason):
        return value.text
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist()
    if isinstance(value, Mapping):
        return {str(key): to_json(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [to_json(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be part of a message")


def to_telemetry(value: object) -> Json:
    """A message to be published: null for every number that is not finite."""
    if type(value) is float:  # the most frequent type: this runs for every number of every message
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: to_telemetry(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [to_telemetry(inner) for inner in value]
    return to_telemetry(value.tolist()) if isinstance(value, np.ndarray | np.generic) else value


def from_json(kind: Any, value: Json) -> Any:
    """The message of this type: a dataclass that `to_json` wrote, or a TypedDict as a peer sent it.

    A missing field that may be None becomes None, as in earlier versions' messages. A TypedDict keeps additional keys,
    as later versions send them. Raises ValueError, with a key and a few words, if the JSON is not such a message.
    """
    return _read(kind, value, "", bounded=is_typeddict(kind))


def _read(kind: Any, value: Json, key: str, *, bounded: bool) -> Any:
    if kind in _NAMES:
        return _plain(kind, value, key, bounded=bounded)
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Reason:
        return Reason(ReasonKind.RECORDED, _plain(str, value, key, bounded=bounded))
    if dataclasses.is_dataclass(kind) or is_typeddict(kind):
        return _fields_read(kind, value, key, bounded=bounded)
    if origin is Annotated:
        return _array(kind, value, key)
    if origin in (Union, types.UnionType):
        return None if value is None else _read(parts[0], value, key, bounded=bounded)
    if origin is None:
        return _plain(kind, value, key, bounded=bounded)
    if isinstance(value, list | dict) and bounded and len(value) > MOST_ITEMS:
        raise ValueError(f"{key} has more than {MOST_ITEMS} entries")
    if origin in (list, tuple):
        if not isinstance(value, list):
            raise ValueError(f"{key} is no list")
        return origin(_read(parts[0], one, f"{key}[{i}]", bounded=bounded) for i, one in enumerate(value))
    if not isinstance(value, dict):
        raise ValueError(f"{key} is no object")  # noqa: TRY004 - likewise
    named = {_plain(str, name, f"a name in {key}", bounded=bounded): one for name, one in value.items()}
    return {parts[0](name): _read(parts[1], one, f"{key}.{name}", bounded=bounded) for name, one in named.items()}


@functools.cache
def _fields(kind: Any) -> dict[str, tuple[Any, bool, bool]]:
    """For each field of a type by name: its type, whether it may be None, and whether it may be missing."""
    missing = dataclasses.MISSING
    given = (
        kind.__optional_keys__
        if is_typeddict(kind)
        else {
            field.name
            for field in dataclasses.fields(kind)
            if field.default is not missing or field.default_factory is not missing
        }
    )
    hints = get_type_hints(kind, include_extras=True)
    return {name: (hint, type(None) in get_args(hint), name in given) for name, hint in hints.items()}


def _fields_read(kind: Any, value: Json, key: str, *, bounded: bool) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{key or 'it'} is no object")  # noqa: TRY004 - likewise
    read = {}
    for name, (hint, optional, given) in _fields(kind).items():
        path = f"{key}.{name}" if key else name
        if name in value:
            read[name] = _read(hint, value[name], path, bounded=bounded)
        elif optional:
            read[name] = None
        elif not given:
            raise ValueError(f"{path} is missing")
    if not is_typeddict(kind):
        return kind(**read)
    if "time_s" in read and read["time_s"] is None:
        raise ValueError("time_s is null")
    return {**value, **read}


def _plain(kind: Any, value: Json, key: str, *, bounded: bool) -> Any:
    if kind is float and not isinstance(value, bool):
        if not bounded and isinstance(value, int | float | str):
            try:
                return float(value)
            except (ValueError, OverflowError) as error:
                raise ValueError(f"{key or 'it'} is no number") from error
        if value is None or isinstance(value, int) or (isinstance(value, float) and math.isfinite(value)):
            return _in_bounds(value, key)
    elif kind is int and isinstance(value, int) and not isinstance(value, bool):
        if abs(value) <= LARGEST_INT:
            return value
    elif kind is str and isinstance(value, str):
        written = value.isascii() or value.encode(errors="ignore").decode() == value  # no unpaired surrogates
        if written and (not bounded or len(value) <= LONGEST_TEXT):
            return value
    elif kind is object or (kind is bool and isinstance(value, bool)):
        return value
    raise ValueError(f"{key} is no {_NAMES.get(kind, 'JSON value')}")


def _in_bounds(value: float | None, key: str) -> float | None:
    name = key.partition("[")[0]
    largest = next((most for unit, most in LARGEST_OF_UNIT.items() if name.endswith(unit)), LARGEST_NUMBER)
    if value is not None and abs(value) > largest:
        raise ValueError(f"{key} is beyond {largest:g}")
    return value


def _shape(kind: Any) -> tuple[int, ...]:
    """The shape of an annotated array. Raises TypeError if none is declared."""
    for part in get_args(kind)[1:]:
        if isinstance(part, Shape):
            return part.sizes
    raise TypeError(f"{kind} declares no shape; annotate it with one")


def _array(kind: Any, value: Json, key: str) -> Any:
    shape = _shape(kind)
    numbers = _read(list[float], value, key, bounded=False)
    if len(numbers) != math.prod(shape):
        raise ValueError(f"{key} has {len(numbers)} numbers, and an array of {_times(shape)} has {math.prod(shape)}")
    return np.array(numbers, dtype=get_args(get_args(get_args(kind)[0])[1])[0]).reshape(shape)


def _times(shape: tuple[int, ...]) -> str:
    return " x ".join(str(size) for size in shape)


def json_schema(kind: Any) -> dict[str, Any]:
    """The JSON schema of a message type, a dataclass or a TypedDict."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Reason:
        return {"type": "string"}
    if dataclasses.is_dataclass(kind) or is_typeddict(kind):
        properties = {name: json_schema(hint) for name, (hint, _, _) in _fields(kind).items()}
        needed = [name for name, (_, optional, _) in _fields(kind).items() if not optional]
        return {"type": "object", "title": kind.__name__, "properties": properties, "required": needed}
    if origin is Annotated:
        shape = _shape(kind)
        numbers = {"type": "array", "items": {"type": "number"}}
        flat = {**numbers, "minItems": math.prod(shape), "maxItems": math.prod(shape)}
        return flat if len(shape) == 1 else {**flat, "description": f"{_times(shape)} matrix, row by row"}
    if origin in (Union, types.UnionType):
        return json_schema(parts[0])
    if origin in (tuple, list):
        return {"type": "array", "items": json_schema(parts[0])}
    if origin is Literal:
        return {"type": "string", "enum": list(parts)}
    return {"type": "object" if origin is not None else _SCHEMAS[kind]}
