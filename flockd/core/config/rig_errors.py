"""How a simulated drone's rig differs from the one that its configuration says."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.core.config.base import Section


class RigErrorsConfig(Section):
    """What each camera of each drone is off, in a direction of its own, drawn from the seed; pilots do not know of it.

    Time stamps that are off: `timing.delay_s`.
    """

    mounting_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Its mounting is turned by so much about some axis, ..."""
    mounting_m: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """... and moved so far."""
    focal: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """Its focal lengths are longer or shorter by this share."""
