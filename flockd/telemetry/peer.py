"""Opens a zenoh session of this computer: a peer that knows nobody but whom it is told of."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import zenoh

from flockd.errors import UnavailableError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_NAME = re.compile(r"[A-Za-z0-9_.-]+")


def open_peer(listen: Sequence[str], connect: Sequence[str], settings: Path | None = None) -> zenoh.Session:
    """A session that listens on and connects to these endpoints only, for ever where nobody is there yet.

    ``settings`` is a file of zenoh's own to begin with: for TLS and access control. Raises UnavailableError when it or
    an endpoint cannot be used.
    """
    endpoints = ", ".join([*listen, *connect]) or "no endpoint"
    try:
        return zenoh.open(_config(listen, connect, settings))
    except zenoh.ZError as error:
        reason = str(error).split(" at ")[0].split(": [")[0]
        with_settings = f" with the settings of {settings}" if settings else ""
        raise UnavailableError(
            f"telemetry cannot use {endpoints}{with_settings} ({reason}); name another endpoint"
        ) from error


def checked_name(name: str) -> str:
    """The name; raises ValueError for one that does not fit into a key."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} does not fit into a key; use letters, digits, '_', '.' and '-'")
    return name


def _config(listen: Sequence[str], connect: Sequence[str], settings: Path | None) -> zenoh.Config:
    """A peer opens without a router, unlike a client; it neither shouts nor hearkens on the network."""
    config = zenoh.Config() if settings is None else zenoh.Config.from_file(str(settings))
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps(list(listen)))
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    config.insert_json5("connect/retry", json.dumps({"period_init_ms": 200, "period_max_ms": 2000}))
    return config
