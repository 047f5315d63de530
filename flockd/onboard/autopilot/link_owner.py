"""One owner for each link: a second process is refused before it can touch anything, whoever has started it."""

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
    """Owns the link to the autopilot, if there is one.

    The owner binds the address's name as one of Linux's abstract sockets. All users of a computer share these; they
    need no folder and end with their process. Raises UnavailableError while another process owns it.
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
    """One text for all addresses of a link: a device may have several names, a port several hosts."""
    kind, _, rest = address.partition("://")
    where, _, number = rest.rpartition(":")
    match kind:
        case "serial":
            return os.path.realpath(where)
        case "udpin" | "tcpin":
            return f"{kind}:{number}"
        case _:
            return address
