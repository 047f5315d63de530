"""The breakages that CI tries: the fixed list fits the sources, and one survivor that nobody explained fails it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tools.checks.breakages import LIST, Breakage, StaleError, fixed, report
from tools.checks.mutants import FILES, ROOT, mutants_of, sample

MUTANTS = list(mutants_of(next(path for path in FILES if path.name == "half_planes.py")))
LISTED = yaml.safe_load(LIST.read_text(encoding="utf-8"))
ENTRY = LISTED["breakages"][0]
ONE, OTHER = (Breakage(name, Path("gate.py"), "", ()) for name in ("one", "other"))


def test_the_fixed_list_fits_the_sources_and_breaks_each_part_that_flies() -> None:
    found = fixed(LISTED["breakages"])
    assert len({one.name for one in found}) == len(found) >= 60
    broken = {part for one in found for part in one.file.with_suffix("").parts}
    assert {"supervisor", "policy", "gate", "fence", "approach", "events", "streamer", "recorder", "sim"} <= broken


@pytest.mark.parametrize("change", [{"old": "no such text"}, {"old": "self"}, {"tests": ["test_none_such"]}])
def test_an_entry_that_fits_no_more_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(StaleError, match=ENTRY["name"]):
        fixed([{**ENTRY, **change}])


def test_a_seed_draws_the_same_mutants_again_and_another_seed_others() -> None:
    drawn = sample(MUTANTS, 20, "a")
    assert len({mutant.name for mutant in drawn}) == 20
    assert drawn == sample(MUTANTS, 20, "a")
    assert drawn != sample(MUTANTS, 20, "b")
    assert sample(MUTANTS, 10_000, "a") == MUTANTS


def test_each_file_of_mutants_has_tests_that_try_them() -> None:
    tests = LISTED["tests of mutants"]
    assert {*tests} - {"others"} <= {path.name for path in FILES}
    assert all((ROOT / "tests/flight/safety" / name).is_file() for names in tests.values() for name in names)


def test_a_survivor_fails_unless_it_is_known_to_mean_the_same() -> None:
    assert report([ONE, OTHER], [], {}, whole=False) == 0
    assert report([ONE, OTHER], [ONE], {}, whole=False) == 1
    assert report([ONE, OTHER], [ONE], {"one": "means the same"}, whole=True) == 0
    assert report([ONE, OTHER], [ONE, OTHER], {"one": "means the same"}, whole=False) == 1


def test_an_explanation_without_a_survivor_is_stale_only_where_all_mutants_were_tried() -> None:
    assert report([OTHER], [], {"one": "means the same"}, whole=False) == 0
    assert report([OTHER], [], {"one": "means the same"}, whole=True) == 1
