"""An argument parser that speaks in one sentence and shows examples."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from flockd.errors import ExitCode


class Parser(argparse.ArgumentParser):
    """With examples below the help, no abbreviated options, and errors of one sentence."""

    def __init__(self, *, prog: str, description: str, examples: Sequence[str]) -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog="\n".join(["examples:", *(f"  {example}" for example in examples)]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def error(self, message: str) -> NoReturn:
        """Says what is wrong with the command line, and where its help is."""
        sys.stderr.write(f"{self.prog}: {message}; see {self.prog} --help\n")
        raise SystemExit(ExitCode.USAGE)


Commands = Callable[[str, str, Sequence[str]], Parser]
"""Adds a command by name, one-line description and examples."""


def add_commands(parser: Parser, additions: Sequence[Callable[[Commands], None]]) -> None:
    """Gives a parser its commands, one of which must be named."""
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=Parser)

    def add(name: str, description: str, examples: Sequence[str]) -> Parser:
        return subparsers.add_parser(
            name, prog=f"{parser.prog} {name}", help=description, description=description, examples=examples
        )

    for addition in additions:
        addition(add)


def positive_number(text: str) -> float:
    """An option's value as a finite number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return number


def positive_count(text: str) -> int:
    """An option's value as a whole number above 0."""
    if not (_is_whole(text) and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number")
    return int(text)


def seed(text: str) -> int:
    """An option's value as a whole number, 0 or more."""
    if not _is_whole(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 0 or more")
    return int(text)


def _is_whole(text: str) -> bool:
    return re.fullmatch("[0-9]{1,18}", text) is not None
