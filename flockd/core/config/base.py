"""Building blocks of the configuration's sections: strict values with units and limits, and finite numbers."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Duration = Annotated[float, Field(gt=0, le=3600)]
"""Seconds; no flight lasts an hour."""
Distance = Annotated[float, Field(gt=0, le=10_000)]
"""Metres; beyond the range of radios and cameras."""
Speed = Annotated[float, Field(ge=0, le=50)]
"""m/s; faster than any vehicle."""
FARTHEST_M = 100_000.0
FromHome = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
"""Metres north or east of home, or of a mission's origin."""
Share = Annotated[float, Field(ge=0, le=1)]
Vector3 = tuple[float, float, float]


def text(pattern: str, words: str) -> Any:
    """The field of a text that has to match a pattern. ``words`` describe it for people: its meaning, then a comma."""
    return Field(pattern=pattern, json_schema_extra={WORDS: words})


WORDS = "words"
"""The key of a JSON schema that holds the words given to `text`."""
NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}$"
Name = Annotated[str, text(NAME, "a name, of up to 64 letters, digits, `_`, and, not in the first place, `.` and `-`")]
PlainName = Annotated[str, text(r"^[a-z0-9_-]+$", "a name, of small letters, digits, `_` and `-`")]


def checked_port(address: str) -> str:
    """Raises ValueError for a number that is no network port, for 0 (any port), and for an impossible host."""
    kind, _, rest = address.partition("/")
    found = re.search(r"^/?(.+):(\d+)(?:[?#].*)?$", rest)
    if found and kind.rstrip(":") in _WITH_PORTS:
        host, port = found.groups()
        if not 0 < int(port) <= 65535:
            raise ValueError(f"{address} has the port {port}; write one from 1 to 65535")
        if not _is_host(host, brackets=not kind.endswith(":")):
            raise ValueError(f"{address} has the host {host}; write an IP address or a computer's name")
    return address


def _is_host(text: str, *, brackets: bool) -> bool:
    """Whether it is an IP address, of version 6 in ``brackets``, or may be a name."""
    number = text[1:-1].partition("%")[0] if brackets and re.fullmatch(r"\[.*\]", text) else text
    if number is text and re.fullmatch(r"[\d.]+", text) is None:
        return re.fullmatch(r"[\w-]+(\.[\w-]+)*\.?", text) is not None
    try:
        return ipaddress.ip_address(number).version == (4 if number is text else 6)
    except ValueError:
        return False


_WITH_PORTS = {"tcp", "udp", "tls", "quic", "ws", "udpin", "udpout", "tcpin", "tcpout"}
Port = AfterValidator(checked_port)
"""The port of a text that ends with an address."""
Endpoint = Annotated[
    str,
    Port,
    text(
        r"^((tcp|udp|tls|quic|ws)/.+:\d+([?#].*)?|(serial|vsock|unixpipe|unixsock-stream)/.+)$",
        "a zenoh endpoint, as in `tcp/0.0.0.0:7447`",
    ),
]


class Section(BaseModel):
    """A part of the configuration."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def refuse(model: BaseModel, faults: Mapping[tuple[str | int, ...], str]) -> None:
    """Raises a validation error with these messages at these keys of the section; does nothing without messages.

    For validators of a section, whose ValueError would be reported for the whole section.
    """
    if faults:
        details = [
            InitErrorDetails(type=PydanticCustomError("value_error", "{error}", {"error": text}), loc=loc, input=model)
            for loc, text in faults.items()
        ]
        raise ValidationError.from_exception_data(type(model).__name__, details)
