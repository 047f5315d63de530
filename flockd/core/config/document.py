"""Reads one YAML file into plain values, each with its place in the file.

Scalars follow the core schema of YAML 1.2 (section 10.3.2), not YAML 1.1: `on` and `no` are words, `010` is ten, `1e3`
is a number, `12:30` is a word. Duplicate keys, anchors, tags and several documents are refused, because they invite
mistakes.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from flockd.core.errors import ConfigError, ConfigProblem, shortage_of

KeyPath = tuple[str | int, ...]
Value = str | int | float | bool | None | tuple["Value", ...] | dict[str, "Value"]

MAX_BYTES = 1 << 20
MAX_DEPTH = 32
MAX_VALUES = 30_000
"""A hundred times the values of flockd's largest file; more would take too long to read."""
LARGEST_INT = 2**63 - 1


@dataclass(frozen=True)
class Place:
    """The place of a value in the file, and its text."""

    file: str
    line: int
    key: str
    written: str

    def problem(self, message: str) -> ConfigProblem:
        """A problem at this place."""
        return ConfigProblem(self.file, self.line, self.key, message)


@dataclass
class Document:
    """The values of one file, their places, and the faults of the YAML itself."""

    file: str
    values: dict[str, Value] = field(default_factory=dict)
    places: dict[KeyPath, Place] = field(default_factory=dict)
    problems: list[ConfigProblem] = field(default_factory=list)


_CALIBRATION = re.compile(r"^(%YAML:1|camera_matrix:|[ \t]+camera_model:)", re.MULTILINE)
"""Of OpenCV, ROS and Kalibr."""


def read_document(path: Path, what: str = "configuration") -> Document:
    """Reads one YAML file; ``what`` names its kind in messages.

    Raises ConfigError with one problem if the file cannot be read at all (missing, not text, not YAML, not a mapping).
    Other faults are listed in `Document.problems`.
    """
    text = _read_text(path, what)
    if _CALIBRATION.search(text):
        raise ConfigError.at(path, "is another program's calibration; `flockd calibrate import FILE` gives its lenses")
    return document_of(text, path, what)


def document_of(text: str, path: Path, what: str) -> Document:
    """The document of a file's text, as `read_document` reads it."""
    try:
        top = _Loader(text, str(path), what).get_single_node()
    except yaml.MarkedYAMLError as error:
        raise ConfigError([_syntax_problem(str(path), text, error)]) from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        message = f"holds the control character {error.character:#04x}; delete it"
        raise ConfigError.at(path, message, line=line) from error
    if top is None or (isinstance(top, yaml.ScalarNode) and not top.value):
        raise ConfigError.at(path, f"is empty; write the {what} into it")
    document = Document(str(path))
    if not isinstance(top, yaml.MappingNode):
        kind = "a list" if isinstance(top, yaml.SequenceNode) else "a single value"
        message = f"is {kind} at its top level; write keys with values, such as `seed: 0`"
        raise ConfigError.at(path, message, line=_line(top))
    values = _value(document, top, (), 1)
    assert isinstance(values, dict)
    document.values = values
    return document


def key_text(path: KeyPath) -> str:
    """A path in the form `rig.cameras[0].name`."""
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


class _Loader(yaml.SafeLoader):
    """Composes nodes; refuses constructs that invite mistakes, and stops early at documents that are too large."""

    def __init__(self, text: str, file: str, what: str) -> None:
        super().__init__(text)
        self._file, self._what = file, what
        self._path: KeyPath = ()
        self._count = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """As PyYAML does. Raises ConfigError."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        outside = self._path
        if index is not None:
            self._path = (*outside, index.value if isinstance(index, yaml.Node) else index)
            self._count += 1
        fault = ""
        if isinstance(event, yaml.AliasEvent):
            fault = f"the alias `*{event.anchor}` is not supported; write the value out"
        elif event.anchor is not None:
            fault = f"the anchor `&{event.anchor}` is not supported; delete it"
        elif event.tag is not None:
            fault = f"the tag `{event.tag}` is not supported; delete it"
        elif index is None and parent is not None and not isinstance(event, yaml.ScalarEvent):
            fault = "a key must be a plain word; write one, as in `seed: 0`"
        elif self._count > MAX_VALUES:
            fault = f"holds more than {MAX_VALUES} values, which no {self._what} does; check the path"
        elif len(self._path) > MAX_DEPTH:
            fault = f"is nested more than {MAX_DEPTH} levels deep; flatten it"
        if fault:
            key = "" if len(self._path) > MAX_DEPTH or self._count > MAX_VALUES else key_text(self._path)
            raise ConfigError.at(self._file, fault, key, event.start_mark.line + 1)
        node = super().compose_node(parent, index)
        self._path = outside
        return node


def _value(document: Document, node: yaml.Node, path: KeyPath, line: int) -> Value:
    """The value of a node; its place is the line of its key or item."""

    def complain(message: str, at: KeyPath = path, line: int = line) -> None:
        document.problems.append(ConfigProblem(document.file, line, key_text(at), message))

    plain = isinstance(node, yaml.ScalarNode) and node.style is None
    written = _shortened(node.value) if isinstance(node, yaml.ScalarNode) else ""
    shown = written if plain or not isinstance(node, yaml.ScalarNode) else f"'{written}'"
    document.places[path] = Place(document.file, line, key_text(path), shown)
    if isinstance(node, yaml.MappingNode):
        values: dict[str, Value] = {}
        for key, inner in node.value:
            here: KeyPath = (*path, key.value)
            if key.value in values:
                first = document.places[here].line
                complain(f"is given twice, first in line {first}; delete one", here, _line(key))
            else:
                values[key.value] = _value(document, inner, here, _line(key))
        return values
    if isinstance(node, yaml.SequenceNode):
        return tuple(_value(document, one, (*path, index), _line(one)) for index, one in enumerate(node.value))
    value = core_scalar(node.value) if plain else node.value
    if not plain and (odd := _UNUSABLE.search(node.value)) is not None:
        complain(f"holds the character {ord(odd[0]):#06x}, which no program takes; delete it")
    if isinstance(value, int) and abs(value) > LARGEST_INT:
        complain(f"{written} is too large; write a number up to {LARGEST_INT}")
        return None
    return value


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1


_UNUSABLE = re.compile("[\0\ud800-\udfff]")
"""Characters that end a text for the system's calls, or are not in UTF-8; in quotes YAML has escapes for both."""
_NUMBERS: tuple[tuple[str, Callable[[str], int | float]], ...] = (
    (r"[-+]?[0-9]+", lambda text: LARGEST_INT + 1 if len(text) > _LONGEST_INT_TEXT else int(text)),
    (r"0o[0-7]+", lambda text: int(text[2:], 8)),
    (r"0x[0-9a-fA-F]+", lambda text: int(text[2:], 16)),
    (r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", float),
    (r"[-+]?\.(inf|Inf|INF)", lambda text: float(text.replace(".", ""))),
)
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
    return next((read(text) for pattern, read in _NUMBERS if re.fullmatch(pattern, text)), text)


def _shortened(text: str, length: int = 40) -> str:
    return text if len(text) <= length else text[:length] + "..."


_GLUED_KEY = re.compile(r"[\s-]*\w+:[^\s:]+\s*")


def _syntax_problem(file: str, text: str, error: yaml.MarkedYAMLError) -> ConfigProblem:
    """The parser's error as a message with the remedy."""
    mark = error.problem_mark or error.context_mark
    assert mark is not None
    lines = [*text.split("\n"), ""]
    line = mark.line + 1
    problem = error.problem or ""
    opened = error.context_mark.line + 1 if error.context_mark is not None else line
    spaced = next((at for at in (line, opened, line - 1) if at and re.search(r"[^\S \t\r]", lines[at - 1])), None)
    dashed = next((at for at in (opened, line, line - 1) if at and re.match(r" *-[\w{\[]", lines[at - 1])), None)
    if spaced is not None:
        line, message = spaced, "another space than the keyboard's stands here, as web pages have it; write a plain one"
    elif dashed is not None and "cannot start" not in problem:
        line, message = dashed, "put a space after the `-`"
    elif "'\\t'" in problem:
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
        line = opened
        message = "a bracket is opened here and not closed properly; check the commas and the closing bracket"
    elif "another document" in problem:
        message = "a second document begins here; keep one in a file"
    elif "incompatible YAML document" in problem:
        message = "the `%YAML` line asks for another YAML version; delete it"
    else:
        message = f"this is not YAML ({problem}); check the indentation here and in the line above"
    return ConfigProblem(file, line, "", message)
