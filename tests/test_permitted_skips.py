"""A skip that nobody permitted fails the run, in whichever way the test skips; the permitted ones are counted."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from tests.permitted_skips import PERMITTED, permitted

ROOT = Path(__file__).parents[1]
OURS = ("-p", "tests.conftest")
WAYS = {
    "call": "import pytest\ndef test_it(): pytest.skip('no reason')\n",
    "mark": "import pytest\n@pytest.mark.skipif(True, reason='no reason')\ndef test_it(): pass\n",
    "fixture": "import pytest\n@pytest.fixture\ndef absent(): pytest.skip('no reason')\ndef test_it(absent): pass\n",
    "module": "import pytest\npytest.skip('no reason', allow_module_level=True)\ndef test_it(): pass\n",
    "import": "import pytest\npytest.importorskip('not_there_at_all', reason='no reason')\ndef test_it(): pass\n",
}


@pytest.mark.parametrize("way", WAYS)
def test_a_skip_that_is_not_permitted_fails_and_is_named(way: str, pytester: pytest.Pytester) -> None:
    pytester.makepyfile(WAYS[way])
    done = pytester.runpytest_inprocess(*OURS)
    outcomes = done.parseoutcomes()
    assert "skipped" not in outcomes
    assert outcomes.get("failed", 0) + outcomes.get("error", outcomes.get("errors", 0)) == 1
    assert "tests/permitted_skips.py does not permit it: " in done.stdout.str()


def test_a_permitted_skip_is_counted_with_the_way_to_run_it(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With xdist, where reports come from other processes."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    folder = pytester.mkdir("tests") / "sitl"
    folder.mkdir()
    text = (
        "import pytest\n@pytest.mark.parametrize('n', [1, 2])\ndef test_it(n): pytest.skip('FLOCKD_PX4 names no build')"
    )
    (folder / "test_it.py").write_text(text, encoding="utf-8")
    (folder / "test_not.py").write_text(WAYS["call"], encoding="utf-8")
    done = pytester.runpytest_subprocess(*OURS, "-n", "1")
    assert done.parseoutcomes() == {"skipped": 2, "failed": 1}
    assert "2 of tests/sitl/*: FLOCKD_PX4 names no; to run: build PX4 SITL" in done.stdout.str()


def test_a_permitted_reason_is_so_for_its_own_tests_only() -> None:
    reason = "Skipped: FLOCKD_PX4 names no SITL build folder of PX4"
    assert permitted("tests/sitl/test_fleet.py::test_px4[1]", reason) is not None
    assert permitted("tests/flight/safety/test_gate.py::test_px4", reason) is None
    assert permitted("tests/sitl/test_fleet.py::test_px4[1]", "Skipped: MAVSDK does not load") is None


def test_every_permitted_reason_is_one_that_a_test_there_gives() -> None:
    paths = [path for path in (ROOT / "tests").rglob("*.py") if path.name != Path(__file__).name]
    tests = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in paths}
    given = {e for e in PERMITTED for at, text in tests.items() if fnmatchcase(at, e.tests) and e.reason in text}
    assert [(entry.tests, entry.reason) for entry in PERMITTED if entry not in given] == []
