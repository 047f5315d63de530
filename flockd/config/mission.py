"""The velocity that the flock should have."""

from __future__ import annotations

from flockd.config.base import NonNegative, Positive, Section


class DesiredVelocityParameters(Section):
    """Eq. 43: a circle, then the tangent."""

    speed_m_s: NonNegative = 1.0
    radius_m: Positive = 10.0
    circle_until_s: NonNegative = 66.0
