"""One owner a link: a second process is refused before it can touch anything, whoever has started it."""

from __future__ import annotations

import hashlib
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.errors import UnavailableError


@contextmanager
def only_owner(autopilot: AutopilotParameters | None) -> Iterator[None]:
    """Owns the link to the autopilot; without one there is nothing to own.

    The owner is who has bound the address's name among Linux's abstract sockets. These are the same for all users of a
    computer, need no folder, and are gone with their process. Raises UnavailableError while another process owns it.
    """
    if autopilot is None:
        yield
        return
    name = "\0flockd " + hashlib.sha256(_place(autopilot.address).encode()).hexdigest()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as own:
        try:
            own.bind(name)
        except OSError as error:
            raise UnavailableError(
                f"autopilot.address: another flockd has the link {autopilot.address}; stop it first, "
                "or give this one its own autopilot's address"
            ) from error
        yield


def _place(address: str) -> str:
    """One text for all addresses of a link: a device has several names, a port several hosts."""
    kind, _, rest = address.partition("://")
    where, _, number = rest.rpartition(":")
    match kind:
        case "serial":
            return os.path.realpath(where)
        case "udpin" | "tcpin":
            return f"{kind}:{number}"
        case _:
            return address
