"""A process beside this one that answers what it is asked: Python code of one process runs on one processor only.

python -m flockd.core.side_process DESCRIPTOR

It reads over the socket of that file descriptor, and ends when the process that started it does, however that ends:
nobody holds the other end of the socket then.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

import flockd
from flockd.core.errors import UnavailableError

PATIENCE_S = 600.0
"""For one answer: longer than a step or a plate takes on a busy computer."""


class SideProcess:
    """Between ``__enter__`` and ``__exit__``. For one thread at a time; what passes is pickled.

    Ctrl-C does not reach the process, which has a session of its own.
    """

    def __init__(
        self, task: str, make: Callable[..., Callable[..., object]], *setup: object, patience_s: float = PATIENCE_S
    ) -> None:
        """Starts it: it calls ``make(*setup)``, while the caller goes on, for what answers. ``task`` is for errors.

        What takes longer than ``patience_s`` is taken for one that hangs.
        """
        self._task, self._patience_s = task, patience_s
        self._connection, others = Pipe()
        with others:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "flockd.core.side_process", f"{others.fileno()}"],
                env=with_package(os.environ),
                stdin=subprocess.DEVNULL,
                pass_fds=[others.fileno()],
                start_new_session=True,
            )
        self._ready = False
        self._send(make, *setup)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()  # it keeps nothing that is not here
        self._process.wait()
        self._connection.close()

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    def wait_until_ready(self) -> None:
        """Until it can answer. Raises what ``make`` did, and UnavailableError when the process has ended or hangs."""
        if not self._ready:
            self._receive()
            self._ready = True

    def ask(self, *order: object) -> Any:
        """The answer. Raises what the answering did, and UnavailableError when the process has ended or hangs."""
        self.wait_until_ready()
        self._send(*order)
        return self._receive()

    def _send(self, *order: object) -> None:
        with suppress(ConnectionError):  # `_receive` says so
            self._connection.send(order)

    def _receive(self) -> Any:
        try:
            if not self._connection.poll(self._patience_s):
                raise UnavailableError(
                    f"the process that {self._task} has not answered for {self._patience_s:g} s; try again, "
                    "with less else for this computer to do"
                )
            answer = self._connection.recv()
        except (EOFError, ConnectionError):
            raise self._ended() from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _ended(self) -> UnavailableError:
        code = self._process.wait()
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return UnavailableError(
            f"the process that {self._task} {how}; if nobody ended it, free some memory, and try again"
        )


def with_package(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment, in which Python finds this package wherever it runs."""
    package, known = str(Path(flockd.__file__).parents[1]), environment.get("PYTHONPATH")
    if known and package in known.split(os.pathsep):
        return dict(environment)
    return {**environment, "PYTHONPATH": f"{package}{os.pathsep}{known}" if known else package}


def main() -> None:
    """Answers until the other process has ended."""
    connection = Connection(int(sys.argv[1]))
    with suppress(EOFError, ConnectionError):
        try:
            make, *setup = connection.recv()
            answer = make(*setup)
            connection.send(None)
            while True:
                connection.send(answer(*connection.recv()))
        except (EOFError, ConnectionError):
            raise
        except Exception as error:  # noqa: BLE001 - the other process raises it again
            error.add_note(traceback.format_exc())
            connection.send(error)


if __name__ == "__main__":
    main()
