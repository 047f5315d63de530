"""One process a drone: a second one is refused before it can touch anything."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from flockd.core.errors import UnavailableError

SERVICE_FOLDER = Path("/run/flockd")
"""Runtime folder of the systemd unit; a process started by hand checks there too."""


@contextmanager
def only_instance(drone: str, environment: Mapping[str, str]) -> Iterator[None]:
    """Holds the drone's lock file. Raises UnavailableError while another process holds it; a dead one holds nothing."""
    path = _lock(_folder(environment), drone)
    with path.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            holder = file.read().strip()
            raise UnavailableError(
                f"{path}: another flockd (process {holder}) flies drone {drone!r}; stop it first, or give this one "
                "another `name`"
            ) from error
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


def service_lock(drone: str) -> Path:
    """The lock file of a flockd that runs as a service; who may not write there cannot see whether it is held."""
    return _lock(SERVICE_FOLDER, drone)


def _lock(folder: Path, drone: str) -> Path:
    return folder / f"flockd-{drone}.lock"


def _folder(environment: Mapping[str, str]) -> Path:
    if os.access(SERVICE_FOLDER, os.W_OK | os.X_OK):
        return SERVICE_FOLDER
    return Path(environment.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
