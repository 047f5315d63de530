"""Messages as JSON and back without losing a bit, and the JSON schema of each: from the types themselves.

A number is written with as many digits as bring the same number back; one that is not finite is the text `NaN`,
`Infinity` or `-Infinity`, which JSON's own grammar lacks. A field that is None is left out. An array of the `Shape` in
its annotation is a flat list of numbers, row by row, as viewers do not take lists of lists. A `Reason` is its text.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np

from flockd.core.messages import Reason, ReasonKind, Shape

Json = Any
"""What `json` writes and reads: text, numbers, booleans, lists, and mappings by text."""


def parsed(data: bytes) -> Json:
    """What stands in JSON from outside. Raises ValueError for what is none, or nested deeper than can be followed."""
    try:
        return json.loads(data)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error


def to_json(value: object) -> Json:
    """A message, or any value within one, in JSON's types. Raises TypeError for what has no place in a message."""
    if isinstance(value, Reason):
        return value.text
    if dataclasses.is_dataclass(value):
        named = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return {name: to_json(inner) for name, inner in named if inner is not None}
    if isinstance(value, np.ndarray):
        return to_json(value.ravel().tolist())
    if isinstance(value, np.generic):
        return to_json(value.item())
    if isinstance(value, Mapping):
        return {str(key): to_json(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [to_json(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"a {type(value).__name__} has no place in a message")


def from_json(kind: Any, value: Json) -> Any:
    """The message of this type that `to_json` wrote. Raises ValueError for JSON that is not one."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Reason:
        return Reason(ReasonKind.RECORDED, _expect(str, value))
    if dataclasses.is_dataclass(kind):
        return _dataclass_from(kind, value)
    if origin is Annotated:
        return _array_from(kind, value)
    if origin in (Union, types.UnionType):
        return None if value is None else from_json(next(part for part in parts if part is not type(None)), value)
    if origin is tuple:
        return tuple(from_json(parts[0], one) for one in _expect(list, value))
    if origin is not None and issubclass(origin, Mapping):
        return {parts[0](key): from_json(parts[1], inner) for key, inner in _expect(dict, value).items()}
    return _number(value) if kind is float else _expect(kind, value)


def json_schema(kind: Any) -> dict[str, Any]:
    """The JSON schema of a message type, a dataclass or a TypedDict."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Reason:
        return {"type": "string"}
    if dataclasses.is_dataclass(kind) or is_typeddict(kind):
        named = get_type_hints(kind, include_extras=True)
        needed = [name for name, hint in named.items() if type(None) not in get_args(hint)]
        properties = {name: json_schema(hint) for name, hint in named.items()}
        return {"type": "object", "title": kind.__name__, "properties": properties, "required": needed}
    if origin is Annotated:
        return _array_schema(_shape(kind))
    if origin in (Union, types.UnionType):
        return json_schema(next(part for part in parts if part is not type(None)))
    if origin in (tuple, list):
        return {"type": "array", "items": json_schema(parts[0])}
    if origin is Literal:
        return {"type": "string", "enum": list(parts)}
    if origin is not None:
        return {"type": "object"}
    return {"type": {bool: "boolean", int: "integer", float: "number", str: "string"}[kind]}


def _shape(kind: Any) -> tuple[int, ...]:
    """The shape of an annotated array. Raises TypeError where none is declared."""
    for part in get_args(kind)[1:]:
        if isinstance(part, Shape):
            return part.sizes
    raise TypeError(f"{kind} declares no shape; annotate it with one")


def _array_schema(shape: tuple[int, ...]) -> dict[str, Any]:
    count = math.prod(shape)
    flat = {"type": "array", "items": {"type": "number"}, "minItems": count, "maxItems": count}
    return flat if len(shape) == 1 else {**flat, "description": f"{_times(shape)} matrix, row by row"}


def _array_from(kind: Any, value: Json) -> Any:
    shape, numbers = _shape(kind), [_number(one) for one in _expect(list, value)]
    if len(numbers) != math.prod(shape):
        raise ValueError(f"{len(numbers)} numbers, where an array of {_times(shape)} has {math.prod(shape)}")
    return np.array(numbers, dtype=get_args(get_args(get_args(kind)[0])[1])[0]).reshape(shape)


def _times(shape: tuple[int, ...]) -> str:
    return " x ".join(str(size) for size in shape)


def _dataclass_from(kind: Any, value: Json) -> Any:
    hints = get_type_hints(kind, include_extras=True)
    given = _expect(dict, value)
    arguments = {}
    for field in dataclasses.fields(kind):
        optional = type(None) in get_args(hints[field.name])
        if field.name in given:
            arguments[field.name] = _field_from(kind, field.name, hints[field.name], given[field.name])
        elif optional:
            arguments[field.name] = None
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ValueError(f"a {kind.__name__} has no {field.name}")
    return kind(**arguments)


def _field_from(kind: Any, name: str, hint: Any, value: Json) -> Any:
    try:
        return from_json(hint, value)
    except ValueError as error:
        raise ValueError(f"{name} of {kind.__name__}: {error}") from error


def _number(value: Json) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"{value!r} is not a number")  # noqa: TRY004 - of the file, not of the caller
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError(f"a number has {len(str(value))} digits") from error


def _expect(kind: Any, value: Json) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{value!r} is not a {kind.__name__}")  # noqa: TRY004 - as above
    return value
