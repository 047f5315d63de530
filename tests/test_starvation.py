"""A process that others keep from running is starved; one that computes is not."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.inner_pytest import pytest_with_our_hooks
from tests.starvation import BEARABLE_S, Starvation, StarvedError, tell

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


def test_a_story_that_fails_while_it_cannot_run_was_starved(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(self: Starvation) -> None:
        self.longest_s = 10 * BEARABLE_S

    async def story() -> None:
        raise AssertionError("it never came")

    monkeypatch.setattr(Starvation, "_watch", stopped)
    with pytest.raises(StarvedError, match=r"stopped this process for 3\.0 s") as raised:
        tell(story)
    assert str(raised.value.__cause__) == "it never came"


FAILS_AT_FIRST = """
from pathlib import Path
import pytest
from tests import starvation
starvation.PAUSE_S = 0.0
RUNS = Path(__file__).with_name("runs")

@pytest.fixture
def fresh(tmp_path):
    assert not list(tmp_path.iterdir()), "set up again for each run"
    (tmp_path / "used").touch()

@pytest.mark.usefixtures("fresh")
def test_it():
    with RUNS.open("a") as runs:
        runs.write(".")
    if len(RUNS.read_text()) <= {failing}:
        raise {error}
"""


@pytest.mark.parametrize(
    ("failing", "error", "runs", "closing"),
    [
        (2, "starvation.StarvedError('no time')", 3, "1 passed"),
        (9, "starvation.StarvedError('no time')", 3, "1 failed"),
        (9, "AssertionError('wrong')", 1, "1 failed"),
    ],
)
def test_a_starved_test_is_run_three_times_and_then_fails(
    failing: int, error: str, runs: int, closing: str, tmp_path: Path
) -> None:
    (tmp_path / "test_it.py").write_text(FAILS_AT_FIRST.format(failing=failing, error=error), encoding="utf-8")
    done = pytest_with_our_hooks(tmp_path)
    assert len((tmp_path / "runs").read_text()) == runs, done.stdout
    assert f"{closing} in" in done.stdout.splitlines()[-1]
    assert done.returncode == (0 if closing == "1 passed" else 1)
    repeated = [line for line in done.stdout.splitlines() if "was starved in" in line]
    assert len(repeated) == (1 if runs == 3 else 0)
