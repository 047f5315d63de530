"""Every fault of the list has its stories, and what these note of reactions is limited."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.stories import REACTION, faults, stories

ROOT = Path(__file__).parents[2]
NAMES = {story.fault for story in stories()}


@pytest.mark.parametrize("name", faults())
def test_a_fault_has_a_story(name: str) -> None:
    assert name in NAMES


def test_stories_are_of_faults_in_the_list_and_rows_are_numbered_without_a_gap() -> None:
    assert faults().keys() >= NAMES
    rows = [fault.row for fault in faults().values()]
    assert rows == list(range(1, len(rows) + 1))


def test_what_has_to_happen_in_time_is_measured() -> None:
    for story in stories():
        file, _, name = story.test.partition("::")
        if story.within_s is not None:
            body = (ROOT / file).read_text(encoding="utf-8").partition(f"def {name}(")[2].partition("\n@pytest")[0]
            assert f'reacted("{story.fault}", ' in body or "reacted(fault, " in body, story


TWO = """
import pytest
@pytest.mark.fault("sigterm", within_s=2.0)
@pytest.mark.parametrize("seconds", [1.5, {slow}])
def test_it(reacted, seconds): reacted("sigterm", seconds)
@pytest.mark.fault({other!r})
def test_other(): pass
"""


@pytest.mark.parametrize(
    ("slow", "other", "options", "passed", "failed", "says"),
    [
        (0.5, "link-lost", (), 3, 0, "sigterm: 1.50 of 2 s"),
        (2.5, "link-lost", (), 2, 1, "the reaction to sigterm took 2.50 s"),
        (0.5, "link-lost", ("--fault", "link-lost"), 1, 0, "2 deselected"),
        (0.5, "gremlins", (), 0, 0, "there is no fault 'gremlins'"),
    ],
)
def test_reactions_are_noted_and_may_not_take_too_long(
    slow: float, other: str, options: tuple[str, ...], passed: int, failed: int, says: str, pytester: pytest.Pytester
) -> None:
    pytester.makeini("[pytest]\nmarkers = fault: a story")
    pytester.makepyfile(TWO.format(slow=slow, other=other))
    done = pytester.runpytest_inprocess("-p", "tests.conftest", "-p", "no:hypothesispytest", *options)
    outcomes = done.parseoutcomes() if passed or failed else {}
    assert (outcomes.get("passed", 0), outcomes.get("failed", 0)) == (passed, failed)
    assert says in done.stdout.str() + done.stderr.str()
    assert REACTION
