"""Messages for values that fail validation: one sentence for each place, with the remedy."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from flockd.core.config.base import WORDS
from flockd.core.config.document import KeyPath, Place, core_scalar
from flockd.core.errors import MAX_PROBLEMS_TOLD, ConfigProblem
from flockd.core.gone import KEYS, MANIFEST_KEYS

Schema = dict[str, Any]

_UNITS = {
    "_m_s2": "metres a second squared",
    "_m_s": "metres a second",
    "_deg_s": "degrees a second",
    "_rad": "radians",
    "_deg": "degrees",
    "_px": "pixels",
    "_s": "seconds",
    "_m": "metres",
}
_LIMITS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def problems_of(
    errors: Sequence[ErrorDetails], model: type[BaseModel], places: Mapping[KeyPath, Place]
) -> list[ConfigProblem]:
    """One problem for each place at which `model` failed its validation.

    Only the first ones by line, which are shown to people, have a remedy.
    """
    root: Schema = model.model_json_schema()
    grouped: dict[KeyPath, list[ErrorDetails]] = {}
    for error in errors:
        if error["type"] == "too_short" and len(error["input"]) >= error["ctx"]["min_length"]:
            continue  # only because entries were refused, which is told of each
        grouped.setdefault(_path_in_file(error, places), []).append(error)
    told = [(_place(path, places), path, group) for path, group in grouped.items()]
    told.sort(key=lambda one: (one[0].file, one[0].line, one[0].key))  # as problems are sorted
    more = "cannot be so; correct the problems before it first"
    return [
        place.problem(_sentence(group, place, path, root, path in places) if number < MAX_PROBLEMS_TOLD else more)
        for number, (place, path, group) in enumerate(told)
    ]


def _path_in_file(error: ErrorDetails, places: Mapping[KeyPath, Place]) -> KeyPath:
    """The path an error is about; for a missing key, and a default that does not fit, one that is not in the file, for
    a list too short the list's."""
    path: KeyPath = tuple(error["loc"])
    rest: KeyPath = ()
    if error["type"] == "missing":
        path, rest = path[:-1], path[-1:] if isinstance(path[-1], str) else ()
    while path not in places:  # pydantic appends the branch of a union
        rest = path[-1:] + rest if error["type"] == "value_error" else rest
        path = path[:-1]
    return path + rest


def _place(path: KeyPath, places: Mapping[KeyPath, Place]) -> Place:
    """The place of a path; for a missing key that of its section."""
    if path in places:
        return places[path]
    section = _place(path[:-1], places)
    key = f"{section.key}.{path[-1]}" if section.key else str(path[-1])
    return Place(section.file, section.line, key, "")


def _sentence(errors: Sequence[ErrorDetails], place: Place, path: KeyPath, root: Schema, is_given: bool) -> str:
    # Of a union's branches, one that fits the type but not the limits says most.
    error = next((error for error in errors if error["type"] in _LIMITS), errors[0])
    kind, value, context = error["type"], error["input"], error.get("ctx", {})
    schema = _schema_at(root, path)
    wanted = _wanted(root, schema, _unit(path))
    shown = place.written or ("a list" if isinstance(value, tuple) else _shown(value))
    if kind == "extra_forbidden":
        keys = ".".join(part for part in path if isinstance(part, str))
        of_manifest = MANIFEST_KEYS.get(re.sub(r"^outputs\.[^.]*\.", "outputs.", keys))
        gone = KEYS.get(keys.removeprefix("drone."), of_manifest)
        if gone is not None:
            return f"is gone; {gone}"
        section = _with_parts(root, _schema_at(root, path[:-1]))
        return _unknown_key(str(path[-1]), sorted(section.get("properties", {})))
    if kind == "missing" and isinstance(value, tuple):
        return f"{_shown(value)}; write {wanted}"
    if kind == "missing":
        return f"is missing; add it with {wanted}"
    if kind in _LIMITS:
        name, words = _LIMITS[kind]
        return f"{shown} is not {words} {context[name]:g}; write {wanted}"
    if kind == "finite_number":
        return f"{shown} is not finite; write {wanted}"
    if kind == "value_error":
        return f"{'' if is_given else 'is not given, and by default '}{context['error']}"
    if value is None:
        return f"has no value; write {wanted}"
    if kind in {"too_short", "too_long"}:
        return f"{_shown(value)}; write {wanted}"
    choices = _choices(root, schema)
    if choices:
        close = difflib.get_close_matches(str(value).lower(), choices, n=1)
        return f"{shown} is not known; " + (f"did you mean `{close[0]}`?" if close else f"write {wanted}")
    short = "a section" if schema.get("type") == "object" else wanted.split(",")[0]
    return f"{shown} is not {short}; {_mend(value, schema, wanted)}"


def _unknown_key(key: str, known: Sequence[str]) -> str:
    word, colon, rest = key.partition(":")
    if colon and word in known:
        return f"is not a key; put a space after the colon: `{word}: {rest}`"
    if key == "<<":
        return "merge keys are not supported; write the values out"
    close = difflib.get_close_matches(key.lower().replace("-", "_"), known, n=1)
    if close:
        return f"is not a known key; did you mean `{close[0]}`?"
    return f"is not a known key; the keys here are {', '.join(known)}"


def _mend(value: object, schema: Schema, wanted: str) -> str:
    """The remedy for a value of the wrong type."""
    numeric = schema.get("type") in {"number", "integer"}
    if isinstance(value, str) and numeric:
        for candidate in (value, value.replace("_", ""), value.replace(",", ".")):
            number = core_scalar(candidate.strip())
            if isinstance(number, int | float) and not isinstance(number, bool) and _is_within(number, schema):
                return f"write {candidate.strip()}"
    whole = isinstance(value, float) and value.is_integer() and _is_within(value, schema)
    if whole and schema.get("type") == "integer":
        return f"write {value:.0f}"
    if schema.get("type") == "boolean" and str(value).lower() in {"on", "yes", "y", "1"}:
        return "write true"
    if schema.get("type") == "boolean" and str(value).lower() in {"off", "no", "n", "0"}:
        return "write false"
    if schema.get("type") == "string" and isinstance(value, int | float):
        return "put it in quotes"
    if "pattern" in schema and isinstance(value, str):
        without_blanks = "_".join(value.split())
        if re.search(schema["pattern"], without_blanks):
            return f"write {without_blanks}"
    return f"write {wanted}"


def _is_within(number: float, schema: Schema) -> bool:
    """Whether a value is within the schema's limits."""
    low, high = schema.get("minimum", -math.inf), schema.get("maximum", math.inf)
    over, under = schema.get("exclusiveMinimum", -math.inf), schema.get("exclusiveMaximum", math.inf)
    return bool(low <= number <= high and over < number < under)


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return f"has {len(value)} {'entry' if len(value) == 1 else 'entries'}"
    if isinstance(value, dict):
        return "a section"
    return f"{value!r}"


def _unit(path: KeyPath) -> str:
    names = [part for part in path if isinstance(part, str)]
    if not names:
        return ""
    return next((f" of {unit}" for suffix, unit in _UNITS.items() if names[-1].endswith(suffix)), "")


def _wanted(root: Schema, schema: Schema, unit: str) -> str:
    """A JSON schema's requirement in words."""
    schema = _resolved(root, schema)
    if "anyOf" in schema:
        return " or ".join(_wanted(root, branch, unit) for branch in schema["anyOf"])
    choices = _choices(root, schema)
    if choices:
        return " or ".join(f"`{choice}`" for choice in choices)
    match schema.get("type"):
        case "number" | "integer":
            return _wanted_number(schema, unit)
        case "boolean":
            return "true or false"
        case "string":
            return str(schema.get(WORDS, "a text"))
        case "null":
            return "nothing"
        case "array":
            count = len(schema.get("prefixItems", ()))
            if count:
                return f"a list of {count} numbers{unit}"
            if "maxItems" in schema:
                return f"a list of {schema.get('minItems', 0)} to {schema['maxItems']} entries"
            return "a list of at least 1 entry" if schema.get("minItems") else "a list"
        case _:
            keys = schema.get("required") or schema.get("properties", {})  # what must be there, or else what may
            return f"a section with {', '.join(sorted(keys))}" if keys else "a section"


def _wanted_number(schema: Schema, unit: str) -> str:
    noun = "whole number" if schema["type"] == "integer" else "number"
    low, high = schema.get("minimum"), schema.get("maximum")
    over, under = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    if over == 0 and high is None and under is None:
        return f"a positive {noun}{unit}"
    if over is not None and high is not None:
        return f"a {noun}{unit} above {over:g} and up to {high:g}"
    if over is not None and under is not None:
        return f"a {noun}{unit} above {over:g} and below {under:g}"
    if low is not None and high is not None:
        return f"a {noun}{unit} from {low:.15g} to {high:.15g}"
    return f"a {noun}{unit}" + (f", {low:g} or more" if low is not None else "")


def _choices(root: Schema, schema: Schema) -> list[str]:
    """The words that a value may be, if it has a fixed list of them."""
    schema = _resolved(root, schema)
    if "anyOf" in schema:
        return [choice for branch in schema["anyOf"] for choice in _choices(root, branch)]
    return [str(choice) for choice in schema.get("enum", [schema["const"]] if "const" in schema else [])]


def _resolved(root: Schema, schema: Schema) -> Schema:
    while "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    return schema


def _with_parts(root: Schema, schema: Schema) -> Schema:
    """The branch that is not null, for the schema of an optional section or list."""
    branches = [_resolved(root, branch) for branch in schema.get("anyOf", ())]
    return next((branch for branch in branches if branch.get("type") in {"object", "array"}), schema)


def _schema_at(root: Schema, path: KeyPath) -> Schema:
    """The part of the schema that describes a path; empty where there is none (an unknown key)."""
    schema = _resolved(root, root)
    for part in path:
        schema = _with_parts(root, schema)
        if isinstance(part, str):
            others = schema.get("additionalProperties")
            schema = schema.get("properties", {}).get(part, others if isinstance(others, dict) else {})
        else:
            prefix = schema.get("prefixItems", ())
            schema = prefix[part] if part < len(prefix) else schema.get("items", {})
        schema = _resolved(root, schema)
    return schema
