"""The breakages that CI tries: the fixed list fits the sources, and one survivor that nobody explained fails it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tools.checks.breakages import LIST, Breakage, StaleError, fixed, report

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


def test_a_survivor_fails_unless_it_is_known_to_mean_the_same() -> None:
    assert report([ONE, OTHER], [], {}, whole=False) == 0
    assert report([ONE, OTHER], [ONE], {}, whole=False) == 1
    assert report([ONE, OTHER], [ONE], {"one": "means the same"}, whole=True) == 0
    assert report([ONE, OTHER], [ONE, OTHER], {"one": "means the same"}, whole=False) == 1
    assert report([OTHER], [], {"one": "means the same"}, whole=True) == 1, "stale where all were tried"
