"""The installed `flockd` as a process: its exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.onboard.test_worker import endless

ROOT = Path(__file__).parents[2]
GIVEN_UP = """
import sys, threading, time
import numpy as np, onnxruntime as ort
import flockd.cli

session, options = ort.InferenceSession(sys.argv[1]), ort.RunOptions()
feeds = {i.name: np.zeros(i.shape, np.float32) for i in session.get_inputs()}
threading.Thread(target=lambda: session.run(None, feeds, options), daemon=True).start()

def main():
    time.sleep(0.5)  # until it runs
    options.terminate = True
    return 78

flockd.cli.main = main
flockd.cli.program()
"""


def test_a_run_of_a_network_that_was_given_up_does_not_take_the_exit_code(tmp_path: Path) -> None:
    """Told to end, it asks for Python once more; where the interpreter takes itself down, that aborts the process."""
    network = endless(tmp_path).with_suffix(".onnx")
    command = [sys.executable, "-c", GIVEN_UP, str(network)]
    assert subprocess.run(command, cwd=ROOT, check=False, timeout=60.0).returncode == 78


def test_what_is_printed_last_is_not_lost() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", "from flockd.cli import program; program()", "models", "list"],
        cwd=ROOT, check=False, capture_output=True, text=True, timeout=60.0,
    )  # fmt: skip
    assert ended.returncode == 0
    assert ended.stdout.startswith("model "), "to a pipe, which is written when it is full or flushed"


SAYS = """
import sys, flockd.cli

def main():
    from flockd.cli.output import say, say_table
    say_table(("heights",), [("4.0\\u20135.0 m",)])
    say(str(3))
    return 0

flockd.cli.main = main
flockd.cli.program()
"""


def test_what_the_terminals_encoding_lacks_is_escaped() -> None:
    """A dash, in Latin 1: the report of a flight that had been flown ended in a traceback."""
    ended = subprocess.run(
        [sys.executable, "-c", SAYS], cwd=ROOT, env={**os.environ, "PYTHONIOENCODING": "latin-1"}, check=False,
        capture_output=True, timeout=60.0,
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert [line.rstrip() for line in ended.stdout.splitlines()] == [b"heights", rb"4.0\u20135.0 m", b"3"]


def test_a_closed_output_is_none() -> None:
    """As with `>&-` in a shell."""
    command = ["sh", "-c", '"$0" -c "$1" >&-', sys.executable, SAYS]
    ended = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, timeout=60.0)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"", b"")


def test_ctrl_c_while_it_is_imported_ends_it_without_a_traceback() -> None:
    interrupts = "import sys, flockd; sys.modules['flockd.cli'] = type(sys)('flockd.cli')\n"
    interrupts += (
        "def __getattr__(name): raise KeyboardInterrupt\nsys.modules['flockd.cli'].__getattr__ = __getattr__\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", f"{interrupts}flockd.program()"],
        cwd=ROOT, check=False, capture_output=True, text=True, timeout=60.0,
    )  # fmt: skip
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "interrupted\n")


def test_linear_algebra_starts_no_threads() -> None:
    counts = """
import os, sys, flockd

def program():
    import numpy
    print(len(os.listdir("/proc/self/task")))

sys.modules["flockd.cli"] = type(sys)("flockd.cli")
sys.modules["flockd.cli"].program = program
flockd.program()
"""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    ended = subprocess.run(
        [sys.executable, "-c", counts], cwd=ROOT, env=environment, check=False, capture_output=True, text=True,
        timeout=60.0,
    )  # fmt: skip
    assert ended.stdout == "1\n", ended.stderr
