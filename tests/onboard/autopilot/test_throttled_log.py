"""What MAVSDK says once a second for as long as an autopilot is dead is in the log once a minute."""

from __future__ import annotations

import logging

import pytest

from flockd.onboard.autopilot.mavsdk_link import MAX_TEXTS, ThrottledLog


def test_a_line_a_second_for_ever_is_one_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    now = [1000.0]
    log = ThrottledLog(logging.getLogger("a test"), clock=lambda: now[0])
    with caplog.at_level(logging.WARNING, "a test"):
        for second in range(181):
            now[0] = 1000.0 + second
            log(logging.ERROR, "Sending message failed")
        log(logging.WARNING, "another")
        log(logging.DEBUG, "below the level")
    repeated = "Sending message failed (59 times more in 60 s)"
    assert caplog.messages == ["Sending message failed", repeated, repeated, repeated, "another"]


def test_texts_that_never_repeat_are_not_all_remembered() -> None:
    log = ThrottledLog(logging.getLogger("a test"), clock=lambda: 0.0)
    for number in range(10 * MAX_TEXTS):
        log(logging.DEBUG, f"number {number}")
    assert len(log._told) <= MAX_TEXTS
