"""Whoever waits is told how far it is, and stdout stays free for the result."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Callable

import pytest

from flockd.cli import output


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _count_to_three(clock: Callable[[], float] = time.monotonic) -> None:
    with output.progress("flying", "steps", clock) as tell:
        for done in (1, 2, 3):
            tell(done, 3)


def test_without_a_terminal_there_is_a_plain_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    _count_to_three()
    assert capsys.readouterr() == ("", ""), "quick work is not worth a line"
    seconds = iter((0.0, 4.0, 12.0, 13.0))  # as the first count begins the phase, then at each count
    _count_to_three(lambda: next(seconds))
    assert capsys.readouterr() == ("", "flying: 2 of 3 steps, 6 s left\n"), "12 s for two, so 6 s for the third"


def test_quiet_is_quiet_and_phases_follow_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    seconds = iter((0.0, 20.0, 90.0, 91.0))
    with output.Phases(quiet=True) as phases:
        phases.of("flying", "steps")(1, 3)
        phases.say("taking off")
    assert capsys.readouterr() == ("", "")
    with output.Phases(clock=lambda: next(seconds)) as phases:
        phases.of("loading", "parts")(1, 2)
        phases.of("flying", "steps")(1, 3)
    assert capsys.readouterr().err == "loading: 1 of 2 parts, 20 s left\n"


def test_on_a_terminal_there_is_a_bar_that_leaves_no_trace(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", terminal := _Terminal())
    _count_to_three()
    assert "flying" in terminal.getvalue()
    assert "3/3" in terminal.getvalue()
    assert terminal.getvalue().endswith("\x1b[2K"), "the line is wiped"
    assert capsys.readouterr().out == ""
