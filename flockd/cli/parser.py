"""An argument parser with errors of one sentence, and examples in its help."""

from __future__ import annotations

import argparse
import difflib
import math
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, Protocol

from flockd.cli.output import complain
from flockd.core.errors import ExitCode, UsageError
from flockd.core.gone import COMMANDS

Number = Callable[[str], float]


class _Help(argparse.RawDescriptionHelpFormatter):
    """Keeps the lines of examples and notes, and wraps a description, which is one line."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        wraps = argparse.HelpFormatter if "\n" not in text else argparse.RawDescriptionHelpFormatter
        return wraps._fill_text(self, text, width, indent)


class Parser(argparse.ArgumentParser):
    """A parser with examples below the help, without abbreviated options, and with errors of one sentence."""

    def __init__(self, *, prog: str, description: str, examples: Sequence[str], notes: str = "") -> None:
        """``notes`` stand below the examples."""
        super().__init__(
            prog=prog,
            description=description,
            epilog="\n".join(["examples:", *(f"  {example}" for example in examples), *(["", notes] if notes else [])]),
            formatter_class=_Help,
            allow_abbrev=False,
        )
        self.register("type", Path, _path)
        self.commands: list[str] = []
        """Names of its commands, if it has any."""
        self.default_command: str | None = None
        """The command that is used if none is named."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse, with the default command if none is named; a named command comes first.

        Removed commands and options are refused with their replacement. argparse would accept options before the
        command, and then overwrite them with the command's own defaults.
        """
        args = sys.argv[1:] if args is None else list(args)
        for place, word in enumerate(args):
            name = word.partition("=")[0]
            gone = COMMANDS.get(f"{self.prog} {name}") if place == 0 or name.startswith("--") else None
            if gone is not None:
                self.error(f"{name} is gone; {gone}")
        if self.default_command is not None and args and args[0] not in {*self.commands, "-h", "--help"}:
            args = [self.default_command, *args]
        parsed, unknown = super().parse_known_args(args, namespace)
        if self.commands and parsed.parser is not self and args[0] not in self.commands:
            name = parsed.parser.prog.removeprefix(self.prog).split()[0]
            self.error(f"{args[0]} stands before the command {name}; write options behind it")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Reports what is wrong with the command line, with a suggestion for a misspelt command."""
        unknown = re.match("argument COMMAND: invalid choice: '(.*?)' ", message)
        if unknown is not None:
            close = difflib.get_close_matches(unknown[1], self.commands, n=1)
            hint = f"; did you mean `{self.prog} {close[0]}`?" if close else f", of {', '.join(self.commands)}"
            message = f"{unknown[1]!r} is not a command{hint}"
        complain(f"{self.prog}: {message}; see {self.prog} --help")
        raise SystemExit(ExitCode.USAGE)


ALONE = "%(prog)s [OPTION ...]\n       %(prog)s COMMAND ..."
"""Usage of a parser that has commands, and does something without one."""


Run = Callable[[argparse.Namespace], int]
"""A command's function: from its options to its exit code."""


class Commands(Protocol):
    """Adds a command."""

    def __call__(
        self, name: str, description: str, examples: Sequence[str], run: Run | None = None, *, notes: str = ""
    ) -> Parser:
        """Adds a command by name, one-line description, examples, function (None: it has its own commands), and the
        notes below the examples in its help."""
        ...


def commands_of(parser: Parser) -> Commands:
    """A function that adds commands to a parser; without a command it prints its help and exits with a usage error.

    A parser that also works without a command gets its own `run` and options afterwards, and `ALONE` as usage.

    The parsed namespace has `run`, the command's function, and `parser`, the command's own.
    """
    subparsers = parser.add_subparsers(metavar="COMMAND", parser_class=Parser)

    def print_help(_: argparse.Namespace) -> int:
        parser.print_help(sys.stderr)
        return ExitCode.USAGE

    parser.set_defaults(run=print_help, parser=parser)

    def add(name: str, description: str, examples: Sequence[str], run: Run | None = None, *, notes: str = "") -> Parser:
        parser.commands.append(name)
        command: Parser = subparsers.add_parser(
            name,
            prog=f"{parser.prog} {name}",
            help=description,
            description=description,
            examples=examples,
            notes=notes,
        )
        command.set_defaults(parser=command, **({} if run is None else {"run": run}))
        return command

    return add


class _Once(argparse.Action):
    """Stores an option's value, and refuses another one: argparse would take the last without a word."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, _: str | None = None
    ) -> None:
        given: set[str] = vars(namespace).setdefault("given", set())
        if self.dest in given:
            raise argparse.ArgumentError(self, "is given twice; leave one out")
        given.add(self.dest)
        setattr(namespace, self.dest, values)


class OnceEach(argparse.Action):
    """Appends a name and its value, and refuses a second value for it, of which only the last would count."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, _: str | None = None
    ) -> None:
        """Raises ArgumentError."""
        before = getattr(namespace, self.dest)
        if values[0] in dict(before):
            raise argparse.ArgumentError(self, f"{values[0]} is given twice; leave one out")
        setattr(namespace, self.dest, [*before, values])


def option(
    parser: argparse._ActionsContainer, spelling: str, what: str, kind: Callable[[str], Any] = str, **more: Any
) -> None:
    """Adds an option, spelled as in `--out FILE`, or an argument, as in `FILE`.

    ``what``: its help; ``kind``: makes its value of the text; ``more``: as argparse takes it.
    """
    name, _, value = spelling.partition(" ")
    if not name.startswith("-"):
        name, value = name.lower(), name
    if value:
        more["metavar"] = value
    if name.startswith("-"):
        more.setdefault("action", _Once)
    parser.add_argument(name, help=what, type=kind, **more)


def _path(text: str) -> Path:
    """Refuses an empty text, as of a shell variable that is not set: it would mean the current folder."""
    if not text:
        raise argparse.ArgumentTypeError("'' is no path; name one")
    return Path(text)


def existing(text: str) -> Path:
    """The kind of an option that names what must be there; `require` checks it."""
    return _path(text)


def require(args: argparse.Namespace) -> None:
    """Raises UsageError for the first of a command's `existing` paths that is missing: one exit code in all commands,
    before anything slow is imported."""
    for action in args.parser._actions:
        given = getattr(args, action.dest, None) if action.type is existing else None
        for path in given if isinstance(given, list) else [given] if given else []:
            if not path.exists():
                raise UsageError(f"{path}: does not exist; check the path")


def flag(parser: argparse._ActionsContainer, name: str, what: str) -> None:
    """Adds an option without a value, false unless it is given."""
    parser.add_argument(name, help=what, action="store_true")


def number(words: str, low: float = -math.inf, high: float = math.inf, *, above: float = -math.inf) -> Number:
    """The kind of an option whose value is a finite number within these limits; ``words`` describe it in errors."""

    def parsed(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and low <= value <= high and value > above):
            raise argparse.ArgumentTypeError(f"{text!r} is not {words}")
        return value

    return parsed


def whole_number(words: str, low: int = 0, high: int = 10**18) -> Callable[[str], int]:
    """The kind of an option whose value is a whole number within these limits."""

    def parsed(text: str) -> int:
        if re.fullmatch("[0-9]{1,18}", text) is None or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not {words}")
        return int(text)

    return parsed


positive_number = number("a positive number", above=0)
duration = number("a number of seconds above 0 and up to 3600", 0, 3600, above=0)
positive_count = whole_number("a positive whole number", 1)
port_number = whole_number("a port, a whole number from 0 to 65535", 0, 65535)


def size(text: str) -> tuple[int, int]:
    """An option's value as two whole numbers above 0, as in 640x480."""
    match = re.fullmatch("([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not two whole numbers with an x between, such as 8x6 or 640x480")
    return int(match[1]), int(match[2])
