"""Turns one YAML file into plain values, each with its place, reading every scalar as a person would.

Scalars follow the core schema of YAML 1.2 (section 10.3.2), not YAML 1.1: `on` and `no` are words, `010` is ten, `1e3`
is a number, `12:30` is a word. What invites mistakes in a configuration (a key given twice, anchors, tags, several
documents) is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import yaml

from flockd.core.errors import ConfigError, ConfigProblem, shortage_of

KeyPath = tuple[str | int, ...]
Value = str | int | float | bool | None | tuple["Value", ...] | dict[str, "Value"]

MAX_BYTES = 1 << 20
MAX_DEPTH = 32
MAX_VALUES = 30_000
"""A hundred times what any of ours holds; reading more takes longer than anyone would wait for an error."""
LARGEST_INT = 2**63 - 1


@dataclass(frozen=True)
class Place:
    """Where a value stands, and how it was written."""

    file: str
    line: int
    key: str
    written: str

    def problem(self, message: str) -> ConfigProblem:
        """A problem at this place."""
        return ConfigProblem(self.file, self.line, self.key, message)


@dataclass
class Document:
    """One file's values, the place of each, and what was wrong with the YAML itself."""

    file: str
    values: dict[str, Value] = field(default_factory=dict)
    places: dict[KeyPath, Place] = field(default_factory=dict)
    problems: list[ConfigProblem] = field(default_factory=list)
    spoiled: set[KeyPath] = field(default_factory=set)
    """Paths whose value is not known because of a problem already listed."""


def read_document(path: Path, what: str = "configuration") -> Document:
    """The values of one YAML file; ``what`` it is, for the messages.

    Raises ConfigError with one problem when nothing can be read from it (missing, not text, not YAML, not a mapping);
    lesser faults are listed in the document's `problems`.
    """
    text = _read_text(path, what)
    document = Document(str(path))
    try:
        _Builder(document, text, what).build()
    except yaml.MarkedYAMLError as error:
        raise ConfigError([_syntax_problem(str(path), text, error)]) from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        message = f"holds the control character {error.character:#04x}; delete it"
        raise ConfigError.at(path, message, line=line) from error
    return document


def key_text(path: KeyPath) -> str:
    """A path as a person writes it: `rig.cameras[0].name`."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return text.removeprefix(".")


def _read_text(path: Path, what: str) -> str:
    fault = partial(ConfigError.at, path)
    try:
        if path.is_dir():
            raise fault("is a folder; name the YAML file in it")
        if path.exists() and not path.is_file():
            raise fault(f"is not an ordinary file; copy the {what} to one")
        with path.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise fault("does not exist; check the path") from error
    except OSError as error:
        if shortage_of(error):
            raise
        raise fault(f"cannot be read ({error.strerror}); check the path and its permissions") from error
    except ValueError as error:
        raise fault(f"is not a path ({error}); check it") from error
    if len(raw) > MAX_BYTES:
        raise fault(f"is larger than {MAX_BYTES // 1024} KiB, which no {what} is; check the path")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise fault("is not UTF-8 text; save the file in UTF-8", line=line) from error


class _Builder:
    """Walks the parser's events once; depth is bounded, so no input can exhaust the stack."""

    def __init__(self, document: Document, text: str, what: str) -> None:
        self._document, self._what = document, what
        self._events: Iterator[yaml.Event] = yaml.parse(text, Loader=yaml.SafeLoader)
        self._count = 0

    def build(self) -> None:
        """Fills the document."""
        if isinstance(self._next_of(yaml.DocumentStartEvent, yaml.StreamEndEvent), yaml.StreamEndEvent):
            raise self._fatal(0, f"is empty; write the {self._what} into it")
        top = next(self._events)
        if isinstance(top, yaml.ScalarEvent) and not top.value:
            raise self._fatal(0, f"is empty; write the {self._what} into it")
        if not isinstance(top, yaml.MappingStartEvent):
            kind = "a list" if isinstance(top, yaml.SequenceStartEvent) else "a single value"
            raise self._fatal(_line(top), f"is {kind} at its top level; write keys with values, such as `seed: 0`")
        values = self._value(top, (), 1)
        assert isinstance(values, dict)
        self._document.values = values
        after = self._next_of(yaml.DocumentStartEvent, yaml.StreamEndEvent)
        if isinstance(after, yaml.DocumentStartEvent):
            self._complain((), _line(after), "a second document begins here; keep one in a file")

    def _next_of(self, *kinds: type[yaml.Event]) -> yaml.Event:
        return next(event for event in self._events if isinstance(event, kinds))

    def _value(self, event: yaml.Event, path: KeyPath, line: int) -> Value:
        """The value that begins with this event; its place is the line of its key or its dash."""
        self._count += 1
        if self._count > MAX_VALUES:
            raise self._fatal(line, f"holds more than {MAX_VALUES} values, which no {self._what} does; check the path")
        if len(path) > MAX_DEPTH:
            raise self._fatal(line, f"is nested more than {MAX_DEPTH} levels deep; flatten it")
        if isinstance(event, yaml.AliasEvent):
            self._remember(path, line, f"*{event.anchor}")
            self._spoil(path, line, f"the alias `*{event.anchor}` is not supported; write the value out")
            return None
        assert isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent)
        if event.anchor is not None:
            self._complain(path, line, f"the anchor `&{event.anchor}` is not supported; delete it")
        if event.tag is not None:
            self._spoil(path, line, f"the tag `{event.tag}` is not supported; delete it")
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event, path, line)
        self._remember(path, line)
        return self._mapping(path) if isinstance(event, yaml.MappingStartEvent) else self._sequence(path)

    def _mapping(self, path: KeyPath) -> dict[str, Value]:
        values: dict[str, Value] = {}
        ignored = (*path, "?")
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            line = _line(event)
            if not isinstance(event, yaml.ScalarEvent) or event.tag is not None or event.anchor is not None:
                self._complain(path, line, "a key must be a plain word, without anchor, alias or tag")
                self._value(event, ignored, line)
                self._value(next(self._events), ignored, line)
            elif event.value in values:
                first = self._document.places[*path, event.value].line
                self._complain((*path, event.value), line, f"is given twice, first in line {first}; delete one")
                self._value(next(self._events), ignored, line)
            else:
                values[event.value] = self._value(next(self._events), (*path, event.value), line)
        return values

    def _sequence(self, path: KeyPath) -> tuple[Value, ...]:
        values: list[Value] = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            values.append(self._value(event, (*path, len(values)), _line(event)))
        return tuple(values)

    def _scalar(self, event: yaml.ScalarEvent, path: KeyPath, line: int) -> Value:
        if event.style is not None:  # quoted, or a block of text
            self._remember(path, line, f"'{_shortened(event.value)}'")
            if (odd := _UNUSABLE.search(event.value)) is not None:
                self._spoil(path, line, f"holds the character {ord(odd[0]):#06x}, which no program takes; delete it")
            return event.value
        value = core_scalar(event.value)
        self._remember(path, line, _shortened(event.value))
        if isinstance(value, int) and abs(value) > LARGEST_INT:
            self._spoil(path, line, f"{_shortened(event.value)} is too large; write a number up to {LARGEST_INT}")
        return value

    def _remember(self, path: KeyPath, line: int, written: str = "") -> None:
        self._document.places[path] = Place(self._document.file, line, key_text(path), written)

    def _complain(self, path: KeyPath, line: int, message: str) -> None:
        self._document.problems.append(ConfigProblem(self._document.file, line, key_text(path), message))

    def _spoil(self, path: KeyPath, line: int, message: str) -> None:
        self._complain(path, line, message)
        self._document.spoiled.add(path)

    def _fatal(self, line: int, message: str) -> ConfigError:
        return ConfigError([*self._document.problems, ConfigProblem(self._document.file, line, "", message)])


def _line(event: yaml.Event) -> int:
    assert event.start_mark is not None
    return event.start_mark.line + 1


_UNUSABLE = re.compile("[\0\ud800-\udfff]")
"""Ends a text for the system's calls, or cannot be written in UTF-8; in quotes YAML has escapes for both."""
_INT = re.compile(r"[-+]?[0-9]+")
_OCTAL = re.compile(r"0o[0-7]+")
_HEX = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)")
_WORDS: dict[str, bool | float | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}
_LONGEST_INT_TEXT = 40


def core_scalar(text: str) -> str | int | float | bool | None:
    """The value of an unquoted scalar by the core schema of YAML 1.2."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) > _LONGEST_INT_TEXT and _INT.fullmatch(text):
        return LARGEST_INT + 1
    if _INT.fullmatch(text):
        return int(text)
    if _OCTAL.fullmatch(text):
        return int(text[2:], 8)
    if _HEX.fullmatch(text):
        return int(text[2:], 16)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _INFINITE.fullmatch(text):
        return float(text.replace(".", ""))
    return text


def _shortened(text: str, length: int = 40) -> str:
    return text if len(text) <= length else text[:length] + "..."


_GLUED_KEY = re.compile(r"[\s-]*\w+:[^\s:]+\s*")


def _syntax_problem(file: str, text: str, error: yaml.MarkedYAMLError) -> ConfigProblem:
    """The parser's error as a message that says what to do."""
    mark = error.problem_mark or error.context_mark
    assert mark is not None
    lines = [*text.split("\n"), ""]
    line = mark.line + 1
    problem = error.problem or ""
    opened = error.context_mark.line + 1 if error.context_mark is not None else line
    if "'\\t'" in problem:
        message = "a tab stands where YAML needs spaces; indent and separate with spaces"
    elif "cannot start any token" in problem:
        sign = problem.split("'")[1]
        message = f"a value cannot begin with `{sign}`; put it in quotes"
    elif "mapping values are not allowed" in problem or "expected ':'" in problem:
        message = "this cannot stand here; check the indentation, and put texts with a `:` in quotes"
        glued = next((at for at in (opened, line, line - 1) if at and _GLUED_KEY.fullmatch(lines[at - 1])), None)
        if glued is not None:
            line, message = glued, "put a space after the `:`"
    elif "quoted scalar" in (error.context or ""):
        line, message = opened, "a quote is opened here and never closed; close it"
    elif "flow" in (error.context or ""):
        line, message = (
            opened,
            "a bracket is opened here and not closed properly; check the commas and the closing bracket",
        )
    elif "found duplicate anchor" in problem or "undefined alias" in problem:
        message = "anchors and aliases are not supported; write the value out"
    elif "incompatible YAML document" in problem:
        message = "the `%YAML` line asks for another YAML version; delete it"
    else:
        message = f"this is not YAML ({problem}); check the indentation here and in the line above"
    return ConfigProblem(file, line, "", message)
