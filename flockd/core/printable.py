"""Makes texts from outside safe for a terminal: control characters are written as escapes."""

from __future__ import annotations

import json


def printable(text: str, *, lines: bool = True) -> str:
    r"""The text with ``\u001b`` for an escape character, and so on, as JSON writes it: control codes, changes of
    direction, surrogates, line ends, and spaces that are not the keyboard's.

    ``lines``: line feeds and tabs are kept.
    """
    kept = "\n\t" if lines else ""
    return "".join(c if c.isprintable() or c in kept else json.dumps(c)[1:-1] for c in text)
