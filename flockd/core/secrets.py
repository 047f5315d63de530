"""Finds and masks passwords in a configuration's texts."""

from __future__ import annotations

import re
from typing import Any

MASK = "***"
_OF_URL = re.compile(r"(?<=://)[^\s\"']*(?=@)")
"""A user and a password before the host: `rtsp://user:password@camera/stream`."""
_QUERY = re.compile(r"\?[^\s\"']+")
"""The query of an address. All its values are masked, because makers name a password `pwd`, `loginpas` or `auth`."""
_VALUE = re.compile(r"(?<=[?&;])([^&;=]*=)?[^&;]+")
_NAMED = re.compile(
    r"([\w-]*(?:passw|passphrase|-pw|pwd|secret|token|key|auth|credential|cookies|extra-headers)[\w-]*\s*=\s*)"
    r"(\"(?:[^\"\\]|\\.)*\"|'[^']*'|[^\s;&#]+)",
    re.IGNORECASE,
)
"""A property of a GStreamer element, a parameter of an address: `user-pw=password`."""


def masked(value: Any) -> Any:
    """A text, or the texts in lists and objects, with `***` for each password."""
    if isinstance(value, str):
        without = _QUERY.sub(lambda query: _VALUE.sub(rf"\1{MASK}", query[0]), _OF_URL.sub(MASK, value))
        return _NAMED.sub(rf"\1{MASK}", without)
    if isinstance(value, dict):
        return {key: masked(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [masked(inner) for inner in value]
    return value
