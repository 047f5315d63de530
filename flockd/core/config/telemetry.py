"""Who may watch a drone, and what they may ask of it."""

from __future__ import annotations

from typing import Literal

from flockd.core.config.base import Endpoint, Name, Section

OperatorCommand = Literal["hold", "land", "resume", "goto", "velocity"]


class TelemetryParameters(Section):
    """Who may watch this drone, and what they may ask of it."""

    fleet: Name = "fleet"
    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)
    """zenoh endpoints at which watchers find this drone, as in `tcp/0.0.0.0:7447`."""
    connect: tuple[Endpoint, ...] = ()
    """zenoh endpoints, of a router or of `flockd status --listen`, that this drone tries to reach for ever."""
    zenoh_config: str | None = None
    """A file of zenoh's own settings to begin with, for TLS and access control; see `config/zenoh_tls.json5`. A
    relative path counts from the folder of the configuration file."""
    commands: tuple[OperatorCommand, ...] = ()
    """What operators may ask over telemetry; by default nothing. `goto` and `velocity` change the drone's mission until
    the flight ends."""
