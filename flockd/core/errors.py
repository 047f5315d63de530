"""Errors that end a command with one sentence and an exit code instead of a traceback."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of commands; 69 and 78 are those of sysexits.h, 130 is the shell's for Ctrl-C."""

    DONE = 0
    CHECK_FAILED = 1
    USAGE = 2
    UNAVAILABLE = 69
    BAD_CONFIGURATION = 78
    INTERRUPTED = 130


class FlockdError(Exception):
    """An error that a person can correct. Its text is complete: one sentence a line."""

    exit_code = ExitCode.CHECK_FAILED


class UsageError(FlockdError):
    """The command line is invalid."""

    exit_code = ExitCode.USAGE


class UnavailableError(FlockdError):
    """A resource is missing: an extra that is not installed, a device, a service."""

    exit_code = ExitCode.UNAVAILABLE


class ModelError(FlockdError):
    """A model file or its manifest is missing, damaged or does not fit its role."""

    exit_code = ExitCode.BAD_CONFIGURATION


@dataclass(frozen=True, order=True)
class ConfigProblem:
    """One fault of a configuration: its place, the fault, and the remedy."""

    file: str
    line: int
    """Counted from 1; 0: no line is at fault (a missing file, an override)."""
    key: str
    """Path inside the file, as in `rig.cameras[0].size_px`; empty for the file as a whole."""
    message: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.key}: {self.message}" if self.key else f"{place}: {self.message}"


MAX_PROBLEMS_TOLD = 20


class ConfigError(FlockdError):
    """All faults of a configuration; the text has one line for each of the first problems."""

    exit_code = ExitCode.BAD_CONFIGURATION

    def __init__(self, problems: Sequence[ConfigProblem]) -> None:
        self.problems = tuple(sorted(problems))
        told = [str(problem) for problem in self.problems[:MAX_PROBLEMS_TOLD]]
        more = len(self.problems) - len(told)
        if more:
            told.append(f"and {more} more {'problem' if more == 1 else 'problems'}; correct these first")
        super().__init__("\n".join(told))

    @classmethod
    def at(cls, file: object, message: str, key: str = "", line: int = 0) -> ConfigError:
        """With one problem."""
        return cls([ConfigProblem(str(file), line, key, message)])


_SHORTAGES = {
    errno.EMFILE: "file descriptors",
    errno.ENFILE: "file descriptors",
    errno.ENOMEM: "memory",
}
_SHORTAGE_TEXTS = {
    "too many open files": "file descriptors",
    "bad_alloc": "memory",
    "cannot allocate memory": "memory",
    "failed to allocate memory": "memory",
    "failed to map segment": "memory",
    "insufficient memory": "memory",
    "can't start new thread": "threads or memory",
    "resource temporarily unavailable": "threads or memory",
}
"""By texts of libraries, in lower case, that raise no error type for it."""


def shortage_of(error: BaseException) -> str | None:
    """The resource that ran out, by the error that it caused; None: another error."""
    if isinstance(error, BaseExceptionGroup):
        return next(filter(None, map(shortage_of, error.exceptions)), None)
    if isinstance(error, MemoryError):
        return "memory"
    if isinstance(error, OSError):
        return _SHORTAGES.get(error.errno or 0)
    text = str(error).lower()
    return next((lacking for part, lacking in _SHORTAGE_TEXTS.items() if part in text), None)
