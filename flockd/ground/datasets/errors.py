"""The error of everything that is wrong with a dataset."""

from __future__ import annotations

from flockd.core.errors import FlockdError


class DatasetError(FlockdError):
    """Something is no dataset, or a part of it is missing, damaged or does not fit the others."""
