"""Errors that end a command with one sentence and an exit code instead of a traceback."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum


class ExitCode(IntEnum):
    """What a command's exit status means; 69 and 78 are the numbers of sysexits.h, 130 the shell's of Ctrl-C."""

    DONE = 0
    CHECK_FAILED = 1
    USAGE = 2
    UNAVAILABLE = 69
    BAD_CONFIGURATION = 78
    INTERRUPTED = 130


class FlockdError(Exception):
    """An error that a person can correct; the text says all, one sentence a line."""

    exit_code = ExitCode.CHECK_FAILED


class UsageError(FlockdError):
    """The command line asks for something that cannot be."""

    exit_code = ExitCode.USAGE


class UnavailableError(FlockdError):
    """Something outside is not there: an extra that is not installed, a device, a service."""

    exit_code = ExitCode.UNAVAILABLE


class ModelError(FlockdError):
    """A model file or its manifest is missing, damaged or does not fit its role."""

    exit_code = ExitCode.BAD_CONFIGURATION


@dataclass(frozen=True, order=True)
class ConfigProblem:
    """One thing wrong with a configuration: where, what, and what to do."""

    file: str
    line: int
    """Counted from 1; 0 where no line is to blame (a missing file, an override)."""
    key: str
    """Path inside the file, as in `rig.cameras[0].size_px`; empty for the file as a whole."""
    message: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.key}: {self.message}" if self.key else f"{place}: {self.message}"


MAX_PROBLEMS_TOLD = 20


class ConfigError(FlockdError):
    """Everything wrong with a configuration at once; its text has one line for each of the first problems."""

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
"""By what libraries say, in lower case, that have no error of their own for it."""


def shortage_of(error: BaseException) -> str | None:
    """What the process or the computer has run out of, by the error that this led to; None for any other error."""
    if isinstance(error, BaseExceptionGroup):
        return next(filter(None, map(shortage_of, error.exceptions)), None)
    if isinstance(error, MemoryError):
        return "memory"
    if isinstance(error, OSError):
        return _SHORTAGES.get(error.errno or 0)
    text = str(error).lower()
    return next((lacking for part, lacking in _SHORTAGE_TEXTS.items() if part in text), None)
