"""How a flight is written down."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from flockd.core.choices import ImageFormat
from flockd.core.config.base import Positive, Section


class RecordingConfig(Section):
    """How a flight is written down, where it is."""

    images: ImageFormat = "png"
    """`png` loses nothing: only then does a replay equal the flight."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 90
    queue_mb: Positive = 64.0
    """What waits for the disk; beyond it steps are dropped."""
    file_mb: Positive = 2000.0
    """Then the recording goes on in a new file."""
    quota_mb: Positive = 20000.0
    """Limit for all recordings of the drone in one folder together: the oldest are deleted to make room. Those of the
    flight before stay, and do not count."""

    @model_validator(mode="after")
    def _a_file_fits(self) -> Self:
        if self.file_mb > self.quota_mb:
            raise ValueError(f"a file of {self.file_mb:g} MB does not fit into {self.quota_mb:g} MB; raise quota_mb")
        return self
