"""Who may open the page and who may command from it: a key in its address, then a session with a token."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
"""Headers of every reply: nothing comes from elsewhere, and nobody else may embed or read it."""
MAX_SESSIONS = 1000


class PageAccess:
    """Sessions of one server. The key opens the page; a session's token, which only its page knows, commands."""

    def __init__(self) -> None:
        self.key = secrets.token_urlsafe(18)
        """Part of the address that the server prints."""
        self._tokens: dict[str, str] = {}

    def open_session(self, key: str) -> str | None:
        """A new session's name for a cookie; None for a wrong key."""
        if not hmac.compare_digest(key.encode(), self.key.encode()):
            return None
        while len(self._tokens) >= MAX_SESSIONS:
            self._tokens.pop(next(iter(self._tokens)))
        session = secrets.token_urlsafe(32)
        self._tokens[session] = secrets.token_urlsafe(32)
        return session

    def token_of(self, session: str | None) -> str | None:
        """The token of a session; None where there is no such session."""
        return None if session is None else self._tokens.get(session)

    def is_token(self, session: str | None, token: object) -> bool:
        """Whether this is the token of this session."""
        known = self.token_of(session)
        return known is not None and isinstance(token, str) and hmac.compare_digest(known.encode(), token.encode())


def is_own_host(host: str) -> bool:
    """Whether a request's Host is this computer by address or by its own name.

    A page of a stranger whose name suddenly leads to this computer (DNS rebinding) sends its own name.
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
    """Whether the page that sends a request is this server's own."""
    return "Origin" in headers and headers["Origin"] == f"http://{headers.get('Host', '')}"
