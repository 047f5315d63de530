"""What a place to attack is: a name, a share of the inputs, and the check that each input has to pass."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random

from flockd.core.errors import FlockdError
from flockd.core.printable import printable

ROOT = Path(__file__).resolve().parents[3]
CORPUS = Path(__file__).parent / "corpus"
LONGEST_ERROR = 20_000
"""Characters that an error may tell a person."""

Check = Callable[[Random], None]
"""Makes one input of the random numbers, gives it to flockd, and raises whatever is no error of flockd's own."""


@dataclass(frozen=True)
class Target:
    """One place where input comes from outside."""

    name: str
    share: int
    """Share of all inputs, relative to the other targets: those that take long get few."""
    prepare: Callable[[Path], Check]
    """Called once with an empty folder."""


@contextmanager
def own_errors() -> Iterator[None]:
    """Lets pass what flockd says in sentences of its own, if a person can read them."""
    try:
        yield
    except FlockdError as error:
        assert_readable(str(error))


def assert_readable(text: str) -> None:
    """Raises AssertionError for a text that is no good on a terminal."""
    shown = printable(text)  # as every command does
    odd = {char for char in shown if char not in "\n\t" and unicodedata.category(char) in ("Cc", "Cf", "Cs")}
    assert not odd, f"control characters {sorted(odd)!a} reach the terminal"
    assert 0 < len(text) <= LONGEST_ERROR, f"an error has {len(text)} characters"


def odd_file(random: Random, path: Path, *, folders: bool = True) -> None:
    """Puts something in a file's place that is no ordinary file: who opens it may wait for ever."""
    path.unlink(missing_ok=True)
    match random.randrange(4 if folders else 3):
        case 0:
            os.mkfifo(path)
        case 1:
            path.symlink_to("/dev/zero")
        case 2:
            path.symlink_to("nowhere")
        case _:
            path.mkdir()


def removed(path: Path) -> None:
    """Removes what `odd_file` may have put there."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
