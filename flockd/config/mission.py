"""The velocity that the flock should have."""

from __future__ import annotations

from flockd.config.base import Distance, NonNegative, Section, Speed


class DesiredVelocityParameters(Section):
    """Eq. 43: a circle, then the tangent."""

    speed_m_s: Speed = 1.0
    radius_m: Distance = 10.0
    circle_until_s: NonNegative = 66.0
