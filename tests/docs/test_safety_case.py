"""The safety case names tests that exist, and every hazard's requirements."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
OPEN = "not shown yet"


def rows(section: str) -> list[list[str]]:
    """The cells of a section's table, without its head."""
    text = PAGE.partition(f"## {section}\n")[2].partition("\n## ")[0]
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def functions_in(file: Path) -> set[str]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return {
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
    }


@pytest.mark.parametrize("row", rows("Requirements"), ids=lambda row: row[0])
def test_each_row_is_shown_by_tests_that_exist(row: list[str]) -> None:
    named = re.findall(r"`([^`]+)`", row[2])
    assert named or row[2] == OPEN, f"{row[0]} {row[1]}: names no test"
    for test in named:
        file, _, function = test.partition("::")
        assert (ROOT / file).is_file(), test
        assert functions_in(ROOT / file), f"{test}: holds no test"
        assert not function or function in functions_in(ROOT / file), test


def test_requirements_are_numbered_and_only_they_are_open_that_say_so() -> None:
    numbers = [row[0] for row in rows("Requirements")]
    assert numbers == [f"R{number}" for number in range(1, len(numbers) + 1)]
    assert OPEN not in "".join(row[2] for row in rows("Requirements"))


def test_what_stands_against_a_hazard_is_a_requirement_and_none_is_idle() -> None:
    against = {name for row in rows("Hazards") for name in re.findall(r"\bR\d+\b", row[3])}
    known = {row[0] for row in rows("Requirements")}
    assert against <= known
    assert known - against <= {"R11"}, "R11 is about the tests, not about a hazard"


def test_the_limits_of_use_lead_to_the_networks_manifests() -> None:
    limits = PAGE.partition("## Limits of use")[2]
    assert "`models/*.yaml`" in limits
    assert "`flockd models list`" in limits
    for manifest in (ROOT / "models").glob("*.yaml"):
        assert re.search(r"^data: \S", manifest.read_text(encoding="utf-8"), re.MULTILINE), manifest
