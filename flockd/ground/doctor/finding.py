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
    """The result of one check of one thing."""

    level: Level
    about: str
    """Which camera, model, parameter ..."""
    measured: str
    fix: str
    """What to do; empty where nothing is to be done."""


def passed(about: str, measured: str) -> Finding:
    """All is well."""
    return Finding(Level.PASS, about, measured, "")


def warned(about: str, measured: str, fix: str) -> Finding:
    """It could be better."""
    return Finding(Level.WARNING, about, measured, fix)


def failed(about: str, measured: str, fix: str) -> Finding:
    """It must not be like this."""
    return Finding(Level.FAILURE, about, measured, fix)


def graded(about: str, measured: str, fix: str, *, failure: bool = False, warning: bool = False) -> Finding:
    """Failed or warned where one of these holds, the worse first; else passed."""
    if failure or warning:
        return Finding(Level.FAILURE if failure else Level.WARNING, about, measured, fix)
    return passed(about, measured)


def failed_from_error(about: str, sentence: str) -> Finding:
    """The failure that an error's sentence describes: our sentences end in what to do, after the last semicolon."""
    measured, _, fix = sentence.rpartition("; ")
    return failed(about, measured or fix, fix if measured else "correct it, and run `flockd doctor` again")
