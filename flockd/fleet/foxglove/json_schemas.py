"""JSON schemas of telemetry's messages, for panels that offer fields by name."""

from __future__ import annotations

import types
import typing
from typing import Any

JsonSchema = dict[str, Any]
_PLAIN = {float: "number", int: "integer", bool: "boolean", str: "string"}


def json_schema(kind: type) -> JsonSchema:
    """Of a TypedDict of telemetry.

    Foxglove's app knows one type a field: one that may be null has its other type here, and an object whose keys are
    not known in advance has none.
    """
    properties = {name: _schema(of_field) for name, of_field in typing.get_type_hints(kind).items()}
    return {"title": kind.__name__, "type": "object", "properties": properties}


def _schema(kind: Any) -> JsonSchema:
    if typing.is_typeddict(kind):
        return json_schema(kind)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in {typing.Union, types.UnionType}:
        return _schema(next(branch for branch in inner if branch is not types.NoneType))
    if origin is list:
        return {"type": "array", "items": _schema(inner[0])}
    return {"type": _PLAIN[kind]} if kind in _PLAIN else {"type": "object", "properties": {}}
