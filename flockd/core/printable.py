"""Makes texts from outside safe for a terminal: control characters are written as escapes."""

from __future__ import annotations

import unicodedata

_STEERING = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories of characters that are escaped: control codes, changes of direction, surrogates, line ends."""


def printable(text: str, *, lines: bool = True) -> str:
    r"""The text with ``\u001b`` for an escape character, and so on, which is also how JSON writes it.

    ``lines``: line feeds and tabs are kept.
    """
    kept = "\n\t" if lines else ""
    if text.isprintable():
        return text
    return "".join(c if c in kept or unicodedata.category(c) not in _STEERING else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i] << 8 | units[i + 1]:04x}" for i in range(0, len(units), 2))
