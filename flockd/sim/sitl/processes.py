"""Programs that run beside the simulator, and that never outlive it; and free ports for them."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import flockd

END_S = 30.0
"""Time to end after SIGTERM, before a program is killed."""
BOUND = ("setpriv", "--pdeathsig", "TERM", "--")
"""Of util-linux: runs a program that gets SIGTERM when the thread that started it ends, however that ends."""
INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_LAST_LINE_BYTES = 4000
FIRST, COUNT = 20_000, 12_000
"""Below those that Linux gives to connections of its own choice (ip_local_port_range begins at 32,768): a port stays
free until it is used."""
_numbers = itertools.count(1009 * os.getpid())
"""Processes begin at different ports, and none gives a port twice in a row."""


@dataclass(frozen=True, eq=False)
class Program:
    """A program that the simulator has started."""

    name: str
    log: Path
    """The file of its output."""
    process: subprocess.Popen[bytes]

    @property
    def ended(self) -> int | None:
        """The exit code; None while the program runs."""
        return self.process.poll()

    def last_output(self) -> str:
        """The last line of its log."""
        with self.log.open("rb") as file:
            file.seek(max(0, self.log.stat().st_size - _LAST_LINE_BYTES))
            lines = file.read().decode(errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "nothing")


class Programs:
    """Programs of one kind, which ``__exit__`` ends.

    Each has a session of its own, so that Ctrl-C reaches the simulator alone, which then ends them in order. One whose
    simulator was killed gets SIGTERM from Linux.
    """

    def __init__(self) -> None:
        self._programs: list[Program] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def __iter__(self) -> Iterator[Program]:
        return iter(self._programs)

    def start(
        self, name: str, command: Sequence[str], environment: Mapping[str, str], folder: Path, log: Path
    ) -> Program:
        """Starts a program in ``folder``, with its output in the file ``log``. For the main thread, as `end`."""
        package, known = str(Path(flockd.__file__).parents[1]), environment.get("PYTHONPATH")
        with _uninterrupted(), log.open("wb") as file:
            process = subprocess.Popen(
                [*BOUND, *command],
                cwd=folder,
                env={**environment, "PYTHONPATH": f"{package}{os.pathsep}{known}" if known else package},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            self._programs.append(Program(name, log, process))
        return self._programs[-1]

    def end(self) -> None:
        """Terminates all that run and waits for them; one that does not end is killed, with all it has started."""
        with _uninterrupted():
            running = [program for program in self._programs if program.ended is None]
            for program in running:
                program.process.terminate()
            until_s = time.monotonic() + END_S
            for program in running:
                try:
                    program.process.wait(max(0.0, until_s - time.monotonic()))
                except subprocess.TimeoutExpired:
                    os.killpg(program.process.pid, signal.SIGKILL)
                    program.process.wait()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ctrl-C and its like wait until the end of this: between them and a program there is nothing to end it."""
    came: list[int] = []
    before = {number: signal.signal(number, lambda number, _: came.append(number)) for number in INTERRUPTS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A free port of this computer, for UDP unless ``kind`` says TCP. Raises OSError if none is free."""
    for number in itertools.islice(_numbers, COUNT):
        port = FIRST + number % COUNT
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(f"none of the ports from {FIRST} to {FIRST + COUNT - 1} is free")


def free_endpoint() -> str:
    """A zenoh endpoint: a TCP port that nobody listens on."""
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
