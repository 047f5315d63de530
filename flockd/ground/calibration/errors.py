"""The error of everything that keeps a calibration from being one."""

from __future__ import annotations

from flockd.core.errors import FlockdError


class CalibrationError(FlockdError):
    """What was shown is not enough, or does not fit together, for numbers anybody should fly with."""
