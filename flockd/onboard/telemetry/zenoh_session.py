"""Opens and closes zenoh sessions, as peers without discovery: the only file that does."""

from __future__ import annotations

import errno
import json
import logging
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import zenoh
from pydantic import TypeAdapter, ValidationError

from flockd.core.config.base import Endpoint
from flockd.core.errors import ExitCode, FlockdError, UnavailableError, UsageError

MOST_REASON = 200
"""Largest number of characters quoted from zenoh in an error."""
_ENDPOINT: TypeAdapter[str] = TypeAdapter(Endpoint)
_log = logging.getLogger(__name__)


class SettingsError(FlockdError):
    """A file of zenoh's settings cannot be used."""

    exit_code = ExitCode.BAD_CONFIGURATION


class SessionError(UnavailableError):
    """Endpoints are not usable."""


def open_session(
    purpose: str,
    listen: Sequence[str],
    connect: Sequence[str],
    *,
    settings: Path | None = None,
    shared_memory: bool | None = None,
    max_message_bytes: int | None = None,
    max_peers: int | None = None,
    awaits_addresses: bool = False,
) -> zenoh.Session:
    """A session that listens on and connects to these endpoints only; it retries for ever until one answers.

    A peer opens without a router, unlike a client; discovery by multicast and gossip is disabled. ``purpose``: its name
    in errors; ``settings``: a file of zenoh's settings to start from, for TLS and access control; unused parts are
    logged. Longer messages and more peers than the limits are refused; None: as in zenoh or the settings.
    ``awaits_addresses``: an address that no interface has yet, such as Wi-Fi's at the start, is listened on once one
    has it. Raises UsageError for what is no endpoint, and UnavailableError.
    """
    for endpoint in (*listen, *connect):
        try:
            _ENDPOINT.validate_python(endpoint)
        except ValidationError:
            told = "is not a zenoh endpoint; write protocol, address and port (1 to 65535), as in `tcp/10.0.0.11:7447`"
            raise UsageError(f"{purpose}: {endpoint} {told}") from None
    wanted = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000},
        "transport/shared_memory/enabled": shared_memory,
        "transport/link/rx/max_message_size": max_message_bytes,
        "transport/unicast/max_sessions": max_peers,
    }
    try:
        usual = zenoh.Config()
        config = zenoh.Config() if settings is None else read_settings(settings)
        for key, value in wanted.items():
            if value is None:
                continue
            own = json.loads(config.get_json(key))
            if own not in (value, json.loads(usual.get_json(key))):
                instead = "name endpoints in telemetry.connect or .listen" if "endpoints" in key else "leave it out"
                _log.warning("%s: %s of %s is %s, and flockd needs %s; %s", purpose, key, settings, own, value, instead)
            config.insert_json5(key, json.dumps(value))
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if not awaits_addresses or f"(os error {errno.EADDRNOTAVAIL})" not in str(error):
                raise
            _log.warning("%s: no interface has the address of %s yet; it is tried again", purpose, ", ".join(listen))
            config.insert_json5("listen/exit_on_failure", "false")
            config.insert_json5("listen/timeout_ms", "-1")
            return zenoh.open(config)
    except zenoh.ZError as error:
        endpoints = ", ".join([*listen, *connect]) or "no endpoint"
        with_settings = f" with the settings of {settings}" if settings else ""
        told = f"{purpose} cannot use {endpoints}{with_settings} ({_reason(error)}); name another endpoint"
        raise SessionError(told) from error


def read_settings(file: Path) -> zenoh.Config:
    """Zenoh's settings of a file. Raises SettingsError."""
    try:
        return zenoh.Config.from_file(str(file))
    except zenoh.ZError as error:
        raise SettingsError(f"{file}: cannot be used as zenoh's settings ({_reason(error)}); correct it") from error


def _reason(error: zenoh.ZError) -> str:
    """Zenoh's error in one short line."""
    words = " ".join(str(error).split(" at ")[0].split(": [")[0].split())
    return words if len(words) <= MOST_REASON else f"{words[:MOST_REASON]}..."


def close_session(session: zenoh.Session) -> None:
    """Ends a session and all its declarations."""
    with suppress(zenoh.ZError):  # raised after ten seconds if a lost peer does not respond
        session.close()  # type: ignore[no-untyped-call]


class SessionOwner:
    """A context manager that ends its session."""

    _session: zenoh.Session

    def close(self) -> None:
        """Ends the session; later messages are lost."""
        close_session(self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
