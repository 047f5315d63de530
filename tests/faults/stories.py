"""The list of faults, and the stories that show what flockd does about each.

A story is a test with the marker ``@pytest.mark.fault(NAME, within_s=...)``. It asserts what `faults.yaml` promises,
and with the fixture `reacted` notes how long the reaction took, which `within_s` limits. `pytest -m fault` runs
all, with `--fault NAME` those of one; those of the process itself start one (`tests.faults.process`).
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

ROOT = Path(__file__).parents[2]
Reacted = Callable[[str, float], None]
"""The fixture: a fault's name, and the seconds after which flockd reacted."""
REACTION = "reaction to "
"""A property of a test's report begins with this, and goes on with the fault's name."""


class Fault(NamedTuple):
    """What happens, and what flockd does."""

    row: int
    fault: str
    reaction: str


class Story(NamedTuple):
    """A test, or all of a file."""

    fault: str
    test: str
    within_s: float | None
    runs: str
    """Where: in CI, by hand with `make flights`, or with PX4."""


@cache
def faults() -> dict[str, Fault]:
    """By name, in the order of their rows."""
    listed = yaml.safe_load(Path(__file__).with_name("faults.yaml").read_text(encoding="utf-8"))
    return {name: Fault(**fault) for name, fault in listed.items()}


def limits(test: pytest.Item) -> dict[str, float | None]:
    """By name, the faults that a test is a story of, and within how many seconds flockd has to react.

    Raises UsageError for one that is not in the list.
    """
    found = {str(mark.args[0]): mark.kwargs.get("within_s") for mark in test.iter_markers("fault")}
    for name in found.keys() - faults().keys():
        raise pytest.UsageError(f"{test.nodeid}: there is no fault {name!r} in tests/faults/faults.yaml")
    return found


def stories() -> list[Story]:
    """All that is marked, by what the sources say."""
    return [story for path in sorted((ROOT / "tests").rglob("test_*.py")) for story in _of_file(path)]


def _of_file(path: Path) -> Iterator[Story]:
    file, source = str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
    runs = "PX4" if file.startswith("tests/sitl/") else "flights" if "pytest.mark.whole_flight" in source else "CI"
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            marked, test = list[ast.AST](node.decorator_list), f"{file}::{node.name}"
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark":
            marked, test = [node.value], file
        else:
            continue
        for call in (call for one in marked for call in ast.walk(one) if isinstance(call, ast.Call)):
            if ast.unparse(call.func) == "pytest.mark.fault":
                within_s = {key.arg: ast.literal_eval(key.value) for key in call.keywords}.get("within_s")
                yield Story(ast.literal_eval(call.args[0]), test, within_s, runs)
