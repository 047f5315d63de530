"""A process that others keep from running is starved; one that computes is not."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

from tests.starvation import BEARABLE_S, Starvation, tell

WATCHES = """
import time
from tests.starvation import Starvation
with Starvation() as starvation:
    print("watching", flush=True)
    input()
print(starvation.longest_s)
"""


def test_a_process_that_is_stopped_for_a_second_was_starved_as_long() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", WATCHES], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "watching\n"
        process.send_signal(signal.SIGSTOP)
        time.sleep(1.0)
        process.send_signal(signal.SIGCONT)
        process.stdin.write("\n")
        process.stdin.flush()
        assert float(process.stdout.readline()) > 0.8


def test_a_process_that_will_not_let_its_own_threads_run_is_not_starved() -> None:
    with Starvation() as starvation:
        begun_s, used_s = time.monotonic(), time.process_time()
        sum(range(30_000_000))  # in C, without letting go of the interpreter
        others_s = time.monotonic() - begun_s - (time.process_time() - used_s)
    assert starvation.longest_s < others_s + 0.1


def test_a_story_that_fails_while_it_can_run_has_failed() -> None:
    async def story() -> None:
        raise AssertionError("it never came")

    with pytest.raises(AssertionError, match="it never came"):
        tell(story)


def test_a_story_that_fails_while_it_cannot_run_is_skipped_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(self: Starvation) -> None:
        self.longest_s = 10 * BEARABLE_S

    async def story() -> None:
        raise AssertionError("it never came")

    monkeypatch.setattr(Starvation, "_watch", stopped)
    with pytest.raises(pytest.skip.Exception, match=r"stopped this process for 3\.0 s: AssertionError"):
        tell(story)
