"""What a check says."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """How well it is."""

    PASS = "PASS"
    WARNING = "WARNING"
    """It flies, but not as well or as safely as it could, or it could not be seen."""
    FAILURE = "FAILURE"
    """Do not fly."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    level: Level
    about: str
    """Which camera, model, parameter ..."""
    measured: str
    mend: str
    """What to do; empty where nothing is to be done."""


def passed(about: str, measured: str) -> Finding:
    """All is well."""
    return Finding(Level.PASS, about, measured, "")


def warned(about: str, measured: str, mend: str) -> Finding:
    """It could be better."""
    return Finding(Level.WARNING, about, measured, mend)


def failed(about: str, measured: str, mend: str) -> Finding:
    """It must not be like this."""
    return Finding(Level.FAILURE, about, measured, mend)


def failed_as_told(about: str, sentence: str) -> Finding:
    """The failure that an error's sentence tells of: our own end in their mend, after the last semicolon."""
    measured, _, mend = sentence.rpartition("; ")
    return failed(about, measured or mend, mend if measured else "mend that, and examine it again")
