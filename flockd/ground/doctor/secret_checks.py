"""Whether files that hold secrets are closed to others: the configuration with a camera's password, and TLS keys."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flockd.core.config import DroneConfig
from flockd.core.secrets import masked
from flockd.ground.doctor.finding import Finding, failed, passed, warned
from flockd.onboard.telemetry.zenoh_session import SessionError, private_keys

_READABLE, _WRITABLE = 0o004, 0o022


def check_secrets(config: DroneConfig, file: Path) -> Iterator[Finding]:
    """``file``: the configuration's."""
    values = config.model_dump(mode="json")
    yield _judged(file, "holds a password" if masked(values) != values else "")
    settings = config.telemetry.zenoh_config
    if settings is None:
        return
    yield _judged(Path(settings), "holds a password" if _holds_password(Path(settings)) else "")
    try:
        keys = private_keys(Path(settings))
    except SessionError as error:
        yield failed("secrets", str(error).rpartition("; ")[0], "correct the file of zenoh's settings")
        return
    for key in keys:
        yield _judged(key, "is a private key")


def _holds_password(file: Path) -> bool:
    try:
        text: Any = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False  # said by what follows
    return '"' in text and ("password:" in text or "_base64:" in text)


def _judged(file: Path, secret: str) -> Finding:
    """``secret``: what others must not read in it; empty where they may."""
    try:
        mode = file.stat().st_mode
    except OSError as error:
        fix = "examine as the user that flies: `sudo -u flockd flockd doctor ...`, or correct the path"
        return warned("secrets", f"{file} cannot be examined ({error.strerror})", fix)
    close = f"`sudo chgrp flockd {file}`, `sudo chmod 640 {file}`: for its owner and the service alone"
    if secret and mode & _READABLE:
        return failed("secrets", f"{file} {secret}, and every user of this computer may read it", close)
    if mode & _WRITABLE:
        return failed("secrets", f"{file} may be changed by others than its owner", f"`sudo chmod go-w {file}`")
    return passed("secrets", f"{file} {secret or 'holds no password'}, mode {mode & 0o777:o}")
