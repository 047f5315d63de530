"""Which pictures of a drone were taken at which distance, as a YAML file says."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from flockd.core.config.base import Section
from flockd.core.config.document import read_document
from flockd.core.config.loader import validated

MAX_DISTANCE_M = 200.0
"""Nobody measures more with a tape, and no network detects a drone there."""


class DistanceConfig(Section):
    """Pictures at one distance."""

    file: Annotated[str, Field(min_length=1)]
    """An image, a folder of images, a video or a recording; relative paths count from the YAML file's folder."""
    distance_m: Annotated[float, Field(gt=0, le=MAX_DISTANCE_M)]
    """From the camera's lens to the drone's middle."""


class DistancesConfig(Section):
    """The whole file."""

    pictures: Annotated[tuple[DistanceConfig, ...], Field(min_length=1)]


def read_distances(path: Path) -> list[tuple[float, Path]]:
    """Distances in metres, with what was photographed there. Raises ConfigError with all that is wrong."""
    listed = validated(DistancesConfig, read_document(path, "list of distances"))
    return [(one.distance_m, path.parent / one.file) for one in listed.pictures]
