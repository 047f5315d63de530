"""Compares the outputs of a flight with those of another, field by field, and keeps outputs as a reference."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flockd.core.data import written_whole
from flockd.onboard.message_json import Json
from flockd.onboard.recording.mcap_file import RecordingError

Outputs = Mapping[int, Mapping[str, Any]]
"""`PilotOutput`s as JSON, by the number of the step."""
NOT_COMPARED = ("stages_ms",)
"""Fields that are not compared: durations."""
ABSENT = "nothing"


@dataclass(frozen=True)
class Difference:
    """One value that is not the same."""

    step: int
    time_s: float
    drone: str
    field: str
    expected: Json
    found: Json

    def __str__(self) -> str:
        return (
            f"{self.drone} differs at {self.time_s:.3f} s (step {self.step}) in {self.field}: "
            f"expected {self.expected!r}, found {self.found!r}"
        )


@dataclass
class FieldDifference:
    """The differences of one field over all steps and all its indices."""

    steps: set[int] = field(default_factory=set)
    largest: float | None = 0.0
    """Largest difference of the numbers; None where something else than a number differs."""


@dataclass
class Comparison:
    """The result of comparing two sets of outputs."""

    steps: int
    values: int
    first: Difference | None
    fields: dict[str, FieldDifference]
    unused: set[str]
    """Names of tolerances that no field begins with."""


def compare(drone: str, expected: Outputs, found: Outputs, tolerances: Mapping[str, float]) -> Comparison:
    """Compares every field of every step; a step that one side lacks is a difference too.

    `tolerances` allows numbers to differ, by field, as in `{"command": 1e-6, "neighbours.position": 0.01}`: the longest
    name that a field begins with counts. Without one, all must be equal.
    """
    result = Comparison(len(expected.keys() | found.keys()), 0, None, {}, set(tolerances))
    for step in sorted(expected.keys() | found.keys()):
        left, right = (dict(_flat(one.get(step, {}))) for one in (expected, found))
        time_s = float(left.get("time_s", right.get("time_s", math.nan)))
        for name in [*left, *(name for name in right if name not in left)]:
            result.values += 1
            result.unused = {one for one in result.unused if not f"{plain(name)}.".startswith(f"{one}.")}
            a, b = left.get(name, ABSENT), right.get(name, ABSENT)
            if _same(a, b, _tolerance(name, tolerances)):
                continue
            result.first = result.first or Difference(step, time_s, drone, name, a, b)
            differing = result.fields.setdefault(plain(name), FieldDifference())
            differing.steps.add(step)
            if differing.largest is not None:
                numbers = _is_number(a) and _is_number(b)
                differing.largest = max(differing.largest, abs(float(a) - float(b))) if numbers else None
    return result


def plain(name: str) -> str:
    """A field without its indices and keys: `detections[1].size_m` is `detections.size_m`."""
    return re.sub(r"\[[^]]*]", "", name)


def save_reference(path: Path, drone: str, outputs: Outputs) -> None:
    """Writes outputs as a reference, a line a step, over an earlier one."""
    lines = [json.dumps({"drone": drone, "steps": len(outputs)})]
    for step, output in outputs.items():
        kept = {name: value for name, value in output.items() if name not in NOT_COMPARED}
        lines.append(json.dumps({"step": step, "output": kept}, allow_nan=False))
    with written_whole(path) as draft:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")


def is_reference(path: Path) -> bool:
    """Whether a file, which may be cut off, begins as `save_reference` begins it."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_BEGINNING)) == _BEGINNING


def load_reference(path: Path) -> Outputs:
    """Reads what `save_reference` wrote. Raises RecordingError, and OSError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        head, *steps = (json.loads(line) for line in lines)
        outputs = {int(line["step"]): dict(line["output"]) for line in steps}
        if any(not isinstance(output["time_s"], float) for output in outputs.values()):
            raise ValueError("a step has no time")  # noqa: TRY301 - wrapped below
        if len(outputs) != head["steps"]:
            raise RecordingError(f"{path}: is cut off after {len(outputs)} of {head['steps']} steps; {_WHAT_TO_DO}")
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: is not a file of reference outputs ({error}); {_WHAT_TO_DO}") from error
    return outputs


_BEGINNING = b'{"drone": '
_WHAT_TO_DO = "restore it, or write it again with --update-reference"


def _flat(value: Json, name: str = "") -> Iterator[tuple[str, Json]]:
    """Every plain value with its name; of a list also its length, as a longer one has more to say."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if name or key not in NOT_COMPARED:
                place = f"{name}[{key}]" if name == "counts" else f"{name}.{key}".lstrip(".")
                yield from _flat(inner, place)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for index, inner in enumerate(value):
            yield from _flat(inner, f"{name}[{index}]")
    else:
        yield name, value


def _same(a: Json, b: Json, tolerance: float) -> bool:
    if _is_number(a) and _is_number(b):
        return bool(a == b or abs(a - b) <= tolerance)
    return type(a) is type(b) and bool(a == b)


def _is_number(value: Json) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _tolerance(name: str, tolerances: Mapping[str, float]) -> float:
    parts = plain(name).split(".")
    for count in range(len(parts), 0, -1):
        if (prefix := ".".join(parts[:count])) in tolerances:
            return tolerances[prefix]
    return 0.0
