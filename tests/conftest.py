"""Fails a skip that `permitted_skips.py` does not list, and runs a real-time test again that the computer starved."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Generator
from typing import Any

import pytest
from _pytest.runner import runtestprotocol  # has no public name; pytest-rerunfailures uses it likewise

from tests import starvation
from tests.permitted_skips import permitted

STARVED = pytest.StashKey[bool]()
STARVED_RUNS = "starved_runs"
"""Property of a report: how many runs of this test were starved. Reports pass between processes, stashes do not."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """Runs a test, fixtures included, until it was not starved, at most `starvation.MAX_RUNS` times."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for run in range(1, starvation.MAX_RUNS + 1):
        item.stash[STARVED] = False
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        if not item.stash[STARVED] or run == starvation.MAX_RUNS:
            break
        item.user_properties[:] = [(STARVED_RUNS, run)]
        time.sleep(starvation.PAUSE_S)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[Any]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A starved run is noted; a skip that is not permitted becomes a failure."""
    report = yield
    if call.excinfo is not None and call.excinfo.errisinstance(starvation.StarvedError):
        item.stash[STARVED] = True
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
    """Of a skip; pytest keeps it as (file, line, "Skipped: reason")."""
    return report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How many tests skipped for which permitted reason and how to run them, and which ones had to be repeated."""
    stats = terminalreporter.stats
    skips = [report for report in stats.get("skipped", []) if not hasattr(report, "wasxfail")]
    if skips:
        terminalreporter.section(f"{len(skips)} permitted skips")
    entries = Counter(permitted(report.nodeid, _reason(report)) for report in skips)
    for entry, count in entries.items():
        if entry is not None:
            terminalreporter.line(f"{count} of {entry.tests}: {entry.reason}; to run: {entry.to_run}")
    for report in [*stats.get("passed", []), *stats.get("failed", [])]:
        runs = dict(report.user_properties).get(STARVED_RUNS)
        if runs is not None and report.when == "call":
            terminalreporter.line(f"{report.nodeid} was starved in {runs} runs and {report.outcome} in the next")
