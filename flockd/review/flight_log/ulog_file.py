"""Reads PX4's ULog files. The one file that knows pyulog, which a damaged file may keep busy for ever.

So it runs in a process of its own, with bounds on its time and memory.
"""

from __future__ import annotations

import contextlib
import os
import resource
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pyulog import ULog
from pyulog.exceptions import ULogException

from flockd.core.errors import UnavailableError, UsageError
from flockd.core.side_process import SideProcess

PATIENCE_S, S_PER_MB = 20.0, 1.0
"""A file is given this long and this much for each megabyte; pyulog takes a tenth of the latter."""
MEMORY_BYTES, MEMORY_PER_BYTE = 2 << 30, 8
"""Address space of the process, likewise; libraries take a third of the first."""
_DAMAGE = (
    *(ULogException, struct.error, OSError, ValueError, IndexError, KeyError, TypeError, AttributeError),
    *(RecursionError, OverflowError, MemoryError),
)


class LoggedText(NamedTuple):
    """A message of the log."""

    time_us: int
    level: int
    """Syslog's; 7 is the least."""
    text: str


@dataclass(frozen=True, eq=False)
class UlogContents:
    """What was asked for of a ULog file."""

    topics: Mapping[str, Mapping[str, Any]]
    """By name the fields of its first instance, arrays each."""
    parameters: Mapping[str, int | float]
    """At the start."""
    texts: Sequence[LoggedText]


def read_contents(path: Path, topics: Sequence[str], patience_s: float = PATIENCE_S) -> UlogContents:
    """What a ULog file holds of these topics. Raises UsageError for what is none, or too damaged, and OSError."""
    if not path.is_file() and path.exists():
        raise unusable(path, "is not an ordinary file")
    with path.open("rb") as file:
        begins, size = file.read(len(ULog.HEADER_BYTES)), path.stat().st_size
    if begins != ULog.HEADER_BYTES:
        raise unusable(path, "does not begin as one")
    allowed_s = patience_s + S_PER_MB * size / 1e6
    memory = MEMORY_BYTES + MEMORY_PER_BYTE * size
    with SideProcess("reads a ULog file", _bounded, memory, patience_s=allowed_s) as process:
        process.wait_until_ready()
        try:
            contents: UlogContents = process.ask(str(path), tuple(topics))
        except UnavailableError as error:
            raise unusable(path, f"cannot be read within {allowed_s:.0f} s, or its memory: it is damaged") from error
        except _DAMAGE as error:
            text = "it needs too much memory" if isinstance(error, MemoryError) else str(error) or type(error).__name__
            raise unusable(path, f"cannot be read: {text.splitlines()[0]}") from error
    return contents


def unusable(path: Path, why: str) -> UsageError:
    """What is told of a file that is of no use."""
    return UsageError(f"{path}: {why}; name a ULog file of this flight, as from the log folder of PX4's SD card")


def _bounded(memory: int) -> Callable[[str, tuple[str, ...]], UlogContents]:
    """In the process: what reads, within this much memory, or less where it has a limit already."""
    limits = [limit for limit in resource.getrlimit(resource.RLIMIT_AS) if limit != resource.RLIM_INFINITY]
    most = min([memory, *limits])
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    return _contents


def _contents(path: str, topics: tuple[str, ...]) -> UlogContents:
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):  # noqa: PTH123
        log = ULog(path, list(topics))
    return UlogContents(
        topics={found.name: dict(found.data) for found in log.data_list if found.multi_id == 0},
        parameters={name: value for name, value in log.initial_parameters.items() if isinstance(value, int | float)},
        texts=[LoggedText(one.timestamp, one.log_level & 0xF, one.message) for one in log.logged_messages],
    )
