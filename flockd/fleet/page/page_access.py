"""Access to the page and its commands: a key in the address opens a session, whose token permits commands."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import os
import re
import secrets
import socket
import stat
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from urllib.parse import urlsplit

from aiohttp import web

from flockd.core.errors import UnavailableError

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
"""Headers of every reply: the page loads no resources from elsewhere, and other sites cannot embed or read it."""
_KEY = re.compile(r"[A-Za-z0-9_-]{16,200}")
_KEY_BYTES = 1024


class PageAccess:
    """Sessions of one key. The key opens the page; commands need the session's token, which only its page knows.

    Sessions and tokens are derived from the key, so they stay valid if the server is restarted with the same key.
    """

    def __init__(self, key: str | None = None) -> None:
        """``key``: None: a new one for this start."""
        self.key = key or _new_key()
        """The key, a part of the address that the server prints."""
        self.cookie = f"flockd_{self._code('cookie', '')[:8]}"
        """Name of the cookie, different for each server, because cookies do not depend on the port."""

    def open_session(self, key: str) -> str | None:
        """A new session for a cookie; None: the key is wrong."""
        if not _same(key, self.key):
            return None
        name = secrets.token_hex(16)
        return f"{name}.{self._code('session', name)}"

    def token_of(self, session: str | None) -> str | None:
        """The token of a session; None: there is no such session."""
        name, _, code = (session or "").partition(".")
        return self._code("token", name) if _same(code, self._code("session", name)) else None

    def is_token(self, session: str | None, token: object) -> bool:
        """Whether this is the token of this session."""
        known = self.token_of(session)
        return known is not None and isinstance(token, str) and _same(known, token)

    def _code(self, purpose: str, name: str) -> str:
        text = f"{purpose} {name}".encode("utf-8", "replace")
        return hmac.new(self.key.encode(), text, hashlib.sha256).hexdigest()


def lasting_key(path: Path) -> str:
    """The key in a file that only its owner may read; makes the file if it does not exist.

    Raises UnavailableError if the file cannot be read, others may read it, or it has no key.
    """
    key = _new_key()
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(f"{key}\n")
    except FileExistsError:
        return _read_key(path)
    except OSError as error:
        raise UnavailableError(f"{path} cannot be made ({error.strerror}); name another --key-file") from error
    return key


def _read_key(path: Path) -> str:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            mode = os.fstat(descriptor).st_mode
            text = file.read(_KEY_BYTES) if stat.S_ISREG(mode) else b""
    except OSError as error:
        raise UnavailableError(f"{path} cannot be read ({error.strerror}); name another --key-file") from error
    if mode & 0o077:
        raise UnavailableError(f"{path} may be read or written by others; `chmod 600 {path}`, or delete it")
    key = text.decode("ascii", "replace").strip()
    if _KEY.fullmatch(key) is None:
        raise UnavailableError(f"{path} holds no key; name a file that is not there yet, and it is made")
    return key


def _new_key() -> str:
    return secrets.token_urlsafe(18)


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode("utf-8", "replace"), other.encode("utf-8", "replace"))


def is_own_host(host: str) -> bool:
    """Whether a request's Host is this computer's address or name.

    After DNS rebinding, a foreign page whose name leads to this computer still sends its own name.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    own = socket.gethostname().lower()
    if name in {"localhost", own, f"{own}.local"}:
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_own_origin(headers: Mapping[str, str]) -> bool:
    """Whether a request comes from a page of this server."""
    return "Origin" in headers and headers["Origin"] == f"http://{headers.get('Host', '')}"


MAX_STRANGERS = 64
"""Largest number of connections without a valid request; a further one closes the oldest."""
STRANGER_S = 10.0
"""Time limit of a request; a browser needs a fraction of a second."""
_TIDY_EVERY_S = 1.0


class PageConnections:
    """A protocol factory for the event loop, around aiohttp's own."""

    def __init__(self, server: web.Server, trusted: set[object], clock: Callable[[], float] = time.monotonic) -> None:
        """``trusted``: connections with a valid request; closed ones are removed here."""
        self._server, self._trusted, self._clock = server, trusted, clock
        self._since_s: dict[web.RequestHandler, float] = {}

    def __call__(self) -> asyncio.Protocol:
        """For a new connection."""
        self._tidy(MAX_STRANGERS - 1)
        return self._server()

    async def run(self) -> None:
        """Closes connections without a request in time, until cancelled."""
        while True:
            await asyncio.sleep(_TIDY_EVERY_S)
            self._tidy(MAX_STRANGERS)

    def _tidy(self, most: int) -> None:
        now_s, connections = self._clock(), self._server.connections
        self._trusted.intersection_update(connections)
        self._since_s = {one: self._since_s.get(one, now_s) for one in connections}
        strangers = [one for one in connections if one not in self._trusted]
        late = sum(now_s - self._since_s[one] > STRANGER_S for one in strangers)
        for one in strangers[: max(late, len(strangers) - most, 0)]:  # aiohttp keeps them in order, the oldest first
            if one.transport is not None:
                one.transport.abort()
