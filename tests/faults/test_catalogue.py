"""The catalogue is whole, its stories are there, and its runner says what became of them."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.faults.catalogue import CATALOGUE, REACTION, Fault, fault_named, reacted
from tools.checks.faults import outcome

ROOT = Path(__file__).parents[2]
ROWS = (*range(1, 68), 77)
FAULT = fault_named("sigterm")


def test_every_row_has_one_name_and_a_story() -> None:
    assert [fault.row for fault in CATALOGUE] == list(ROWS)
    assert len({fault.name for fault in CATALOGUE}) == len(ROWS)
    assert all(fault.stories for fault in CATALOGUE)


@pytest.mark.parametrize("fault", CATALOGUE, ids=lambda fault: str(fault.name))
def test_its_stories_are_tests_that_exist(fault: Fault) -> None:
    for story in fault.stories:
        file, _, name = story.partition("[")[0].partition("::")
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        tests = {
            node.name
            for node in tree.body
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
        }
        assert name in tests if name else tests, story


def test_a_reaction_is_noted_and_may_not_take_too_long() -> None:
    noted: dict[str, object] = {}
    reacted(noted.__setitem__, "sigterm", 1.2344)
    assert noted == {f"{REACTION}sigterm": 1.234}
    with pytest.raises(AssertionError, match=r"the reaction to sigterm took 2\.50 s"):
        reacted(noted.__setitem__, "sigterm", 2.5)


def _report(*cases: str) -> ET.Element:
    return ET.fromstring(f"<testsuites><testsuite>{''.join(cases)}</testsuite></testsuites>")


def _passed(seconds: float) -> str:
    noted = f'<property name="{REACTION}sigterm" value="{seconds}"/>'
    return f'<testcase name="a"><properties>{noted}</properties></testcase>'


SKIPPED = '<testcase name="b"><skipped message="FLOCKD_PX4 names no SITL build folder"/></testcase>'
FAILED = '<testcase name="c"><failure message="AssertionError: it never came&#10;more"/></testcase>'


@pytest.mark.parametrize(
    ("cases", "code", "row"),
    [
        ((_passed(1.5), _passed(0.5)), 0, ("pass", 1.5, "")),
        ((_passed(1.5), SKIPPED), 0, ("pass", 1.5, "1 of 2 stories skipped: FLOCKD_PX4 names no SITL build folder")),
        ((SKIPPED,), 0, ("skip", None, "FLOCKD_PX4 names no SITL build folder")),
        ((_passed(1.5), FAILED, SKIPPED), 1, ("fail", 1.5, "c: AssertionError: it never came")),
        ((), 4, ("fail", None, "pytest ended with exit code 4, 0 stories run")),
        ((_passed(1.5),), -11, ("fail", 1.5, "pytest ended with exit code -11, 1 stories run")),
    ],
)
def test_a_fault_passes_only_if_all_its_stories_that_could_run_did(
    cases: tuple[str, ...], code: int, row: tuple[str, float | None, str]
) -> None:
    found = outcome(FAULT, _report(*cases), code)
    assert (found.result, found.reaction_s, found.why) == row


def test_the_command_runs_what_it_is_asked_for() -> None:
    command = [sys.executable, "-m", "tools.checks.faults"]
    unknown = subprocess.run([*command, "--only", "gremlins"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert unknown.returncode == 2
    assert unknown.stderr == "faults: there is no fault 'gremlins'; --list prints their names\n"
    ended = subprocess.run(
        [*command, "--only", "false-neighbour", "--json"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert json.loads(ended.stdout) == {
        "faults": [{"name": "false-neighbour", "row": 18, "result": "pass", "reaction_s": None, "why": ""}]
    }
