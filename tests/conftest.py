"""Fails a skip that `permitted_skips.py` does not list, runs tests that are coroutines, and knows stories of faults."""

from __future__ import annotations

import asyncio
import os
import platform
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

if platform.machine() == "x86_64":
    # Before numpy is imported: with its routines for AVX-512, two recorded flights come out otherwise.
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

from flockd.cli import main
from tests.calm import run_coroutine_test
from tests.faults.stories import REACTION, Reacted, limits
from tests.permitted_skips import permitted
from tests.worlds import generate_anew, share_worlds

__all__ = ["generate_anew"]

settings.register_profile("many", max_examples=10_000)
"""A hundred times as many inputs of `tests/hostile`, others each time: `--hypothesis-profile=many`."""

OWN_EXTRAS = {"tools/training/test_learning.py": "training", "fleet/page/test_browser.py": "browser"}
"""Files whose imports need more than `make test` installs, and the marker by which their own target asks for them."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Such a file is not even imported where its marker is not asked for."""
    tests = Path(__file__).parent
    place = collection_path.relative_to(tests).as_posix() if tests in collection_path.parents else ""
    marker = OWN_EXTRAS.get(place)
    return True if marker not in (None, config.option.markexpr) else None


def pytest_configure(config: pytest.Config) -> None:
    share_worlds(config)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fault", metavar="NAME", help="run the stories of one fault of docs/reference/faults.md")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """A story is of a fault that is in the list."""
    wanted = config.getoption("fault")
    left_out = [item for item in items if wanted not in {None, *limits(item)}]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


@pytest.fixture
def reacted(request: pytest.FixtureRequest, record_property: Callable[[str, object], None]) -> Reacted:
    """Notes how long the reaction to a fault took; an assertion fails when that was too long."""

    def note(fault: str, seconds: float) -> None:
        limit_s = limits(request.node)[fault]
        assert limit_s is not None, f"its marker says of {fault} no `within_s`"
        record_property(f"{REACTION}{fault}", (round(seconds, 3), limit_s))
        assert 0.0 <= seconds <= limit_s, f"the reaction to {fault} took {seconds:.2f} s"

    return note


Told = Callable[..., str]
"""A command's exit code and its arguments: what stands on stdout, or the one sentence on stderr."""


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Told:
    """`flockd` as a person runs it, in this process."""

    def run(code: int, *arguments: object) -> str:
        capsys.readouterr()
        try:
            ended = main([str(argument) for argument in arguments])
        except SystemExit as exit_:
            ended = int(exit_.code or 0)
        captured = capsys.readouterr()
        assert ended == code, captured.err
        assert code == 0 or (captured.out, captured.err.count("\n")) == ("", 1), captured
        return captured.err if code else captured.out

    return run


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """An `async def` test runs in real time; a folder's own `conftest.py` may choose another clock."""
    return run_coroutine_test(pyfuncitem, lambda story: asyncio.run(story()))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[Any]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A skip that is not permitted becomes a failure."""
    report = yield
    if report.skipped and not hasattr(report, "wasxfail"):
        _fail_unless_permitted(report)
    return report


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """A module that skips as a whole is held to the same list."""
    report = yield
    if report.skipped:
        _fail_unless_permitted(report)
    return report


def _fail_unless_permitted(report: pytest.TestReport | pytest.CollectReport) -> None:
    reason = _reason(report)
    if permitted(report.nodeid, reason) is None:
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} skipped, and tests/permitted_skips.py does not permit it: {reason}"


def _reason(report: pytest.TestReport | pytest.CollectReport) -> str:
    """The reason of a skip; pytest keeps it as (file, line, "Skipped: reason")."""
    return report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How many tests skipped for which permitted reason and how to run them."""
    stats = terminalreporter.stats
    skips = [report for report in stats.get("skipped", []) if not hasattr(report, "wasxfail")]
    if skips:
        terminalreporter.section(f"{len(skips)} permitted skips")
    entries = Counter(permitted(report.nodeid, _reason(report)) for report in skips)
    for entry, count in entries.items():
        if entry is not None:
            terminalreporter.line(f"{count} of {entry.tests}: {entry.reason}; to run: {entry.to_run}")
    reactions: dict[str, tuple[float, float]] = {}
    for report in (*stats.get("passed", []), *stats.get("failed", [])):
        for name, value in report.user_properties if report.when == "call" else ():
            if str(name).startswith(REACTION):
                fault = str(name).removeprefix(REACTION)
                reactions[fault] = max(tuple(value), reactions.get(fault, (0.0, 0.0)))
    if reactions:
        terminalreporter.section("reactions to faults")
    for fault, (seconds, limit_s) in sorted(reactions.items()):
        terminalreporter.line(f"{fault}: {seconds:.2f} of {limit_s:g} s")
