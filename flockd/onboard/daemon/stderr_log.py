"""The log on standard error, which never makes the event loop wait for whoever reads it."""

from __future__ import annotations

import logging
import os

from flockd.core.printable import printable
from flockd.onboard.daemon.worker import BusyError, Worker

BACKLOG = 1000
"""Lines that may wait."""
CLOSE_S = 1.0
"""Given at the end to whoever reads them."""
STDERR = 2


class StderrLog(logging.Handler):
    """Writes log lines from a thread of its own; those that come while too many wait are lost, and counted.

    A write to a full pipe, to a journal that hangs or to a file on a busy disk takes as long as the other side likes.
    Lines contain texts of the autopilot and of operators: they are made fit for terminals.
    """

    def __init__(self, descriptor: int = STDERR) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._worker = Worker("log", BACKLOG)
        self._lost = 0

    def emit(self, record: logging.LogRecord) -> None:
        """One line, from any thread; does not wait."""
        lost = f"({self._lost} lines were lost: nobody read them)\n" if self._lost else ""
        try:
            self._worker.submit(self._write, f"{lost}{printable(self.format(record))}\n")
        except BusyError:
            self._lost += 1
        else:
            self._lost = 0

    def close(self) -> None:
        """Waits a moment for the lines that are left."""
        self._worker.leave(CLOSE_S)
        super().close()

    def _write(self, text: str) -> None:
        # Not by sys.stderr, whose lock the process would wait for when it ends.
        data = text.encode("utf-8", "backslashreplace")
        while data:
            data = data[os.write(self._descriptor, data) :]
