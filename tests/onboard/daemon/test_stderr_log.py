"""A slow reader of the log, or none, does not delay the daemon."""

from __future__ import annotations

import logging
import os
import re
import threading
import time

from flockd.onboard.daemon.message_sinks import MOST_LINES, StderrLog

PIPE_BYTES = 1 << 16
"""What Linux keeps for a reader that does not come."""
LINE = "x" * 1000
LOST = re.compile(r"\((\d+) lines were lost: nobody read them\)")


def _logged(log: StderrLog, text: str, times: int = 1) -> None:
    for _ in range(times):
        log.emit(logging.LogRecord("flockd", logging.INFO, "", 0, text, None, None))


def _all_of(reader: int) -> list[str]:
    data = b""
    while block := os.read(reader, PIPE_BYTES):
        data += block
    return data.decode().splitlines()


def test_a_reader_that_does_not_come_stops_nobody_and_what_was_lost_is_counted() -> None:
    reader, writer = os.pipe()
    log, many = StderrLog(writer), 2 * MOST_LINES
    said = threading.Thread(target=_logged, args=(log, LINE, many), daemon=True)
    said.start()
    said.join(30.0)
    assert not said.is_alive(), "2 MB went into a pipe of 64 kB, and nobody has read"

    lines: list[str] = []
    reading = threading.Thread(target=lambda: lines.extend(_all_of(reader)), daemon=True)
    reading.start()
    until_s = time.monotonic() + 30.0
    while time.monotonic() < until_s and not log._worker._jobs.empty():
        time.sleep(0.01)
    _logged(log, "the last")
    log.close()
    os.close(writer)
    reading.join(30.0)
    os.close(reader)
    whole = lines.count(LINE)
    assert MOST_LINES <= whole <= MOST_LINES + PIPE_BYTES // len(LINE) + 1
    lost = [int(match[1]) for line in lines if (match := LOST.fullmatch(line))]
    assert sum(lost) == many - whole, "each lost line is counted, once"
    assert lines[-1] == "the last"
    assert len(lines) == whole + len(lost) + 1


def test_control_characters_of_others_do_not_reach_the_terminal() -> None:
    reader, writer = os.pipe()
    log = StderrLog(writer)
    _logged(log, "autopilot: \x1b[2J ready")
    log.close()
    os.close(writer)
    (line,) = _all_of(reader)
    os.close(reader)
    assert "\x1b" not in line
    assert line.startswith("autopilot: ")
    assert line.endswith("ready")
