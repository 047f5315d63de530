"""What a dataset gives: frames with an image, and depth and pose where they are known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flockd.core.config.rig import CameraConfig
from flockd.core.messages import UInt8Array
from flockd.flight.geometry import RigidTransform, ZMap
from flockd.ground.datasets.errors import DatasetError
from flockd.ground.datasets.image_files import read_depth, read_image


@dataclass(frozen=True, eq=False)
class Moment:
    """When and where an image was taken."""

    index: int
    """Counted from 0 at the dataset's first frame."""
    name: str
    time_s: float
    T_world_camera: RigidTransform | None
    """From optical RDF to the dataset's world; None where it is not known."""


@dataclass(frozen=True, eq=False)
class DatasetFrame:
    """One image of the dataset's camera, and what is known with it."""

    moment: Moment
    image: UInt8Array
    """(h, w, 3) RGB."""
    depth: ZMap | None
    """(h, w) metres along the optical axis, NaN where there is none; None where it was not asked for."""


@dataclass(frozen=True)
class Entry:
    """Where the parts of one frame are."""

    name: str
    time_s: float
    image: Path
    depth: Path | None = None
    T_world_camera: RigidTransform | None = None


@dataclass(frozen=True, eq=False)
class Dataset:
    """A sequence of images of one camera; each image, and each depth map, is a file."""

    path: Path
    camera: CameraConfig
    """The one that took it; pixel centres at +0.5."""
    entries: tuple[Entry, ...]
    depth_units_per_m: float = 1000.0
    notes: tuple[str, ...] = ()
    """What a person should know although nothing is wrong: each is one sentence."""

    def __post_init__(self) -> None:
        """Raises DatasetError if a file is missing: better now than after an hour."""
        for entry in self.entries:
            for file in (entry.image, entry.depth):
                if file is not None and not file.is_file():
                    raise DatasetError(f"{file}: is missing; restore it, or leave its frame out")

    @property
    def has_depth(self) -> bool:
        """Whether depth was recorded."""
        return any(entry.depth for entry in self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def frames(self, *, with_depth: bool) -> Iterator[DatasetFrame]:
        """All frames in order, read one by one. Raises DatasetError at one that is missing or damaged."""
        size = self.camera.size_px
        for index, entry in enumerate(self.entries):
            depth = ZMap(read_depth(entry.depth, size, self.depth_units_per_m)) if with_depth and entry.depth else None
            image = read_image(entry.image, size)
            yield DatasetFrame(Moment(index, entry.name, entry.time_s, entry.T_world_camera), image, depth)
