"""Pictures on disk: images, folders of them, and the frames of videos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flockd.core.config.base import Positive
from flockd.core.config.document import key_text
from flockd.core.errors import UsageError
from flockd.core.messages import UInt8Array
from flockd.ground.datasets.image_files import (
    SUFFIXES,
    VIDEO_SUFFIXES,
    DatasetError,
    images_of_video,
    opened_video,
    read_image,
)
from flockd.ground.pictures.single_frame import Box


@dataclass(frozen=True)
class PictureFile:
    """An image or a video."""

    path: Path
    root: Path
    """The folder that was named, or the one that the file is in."""

    @property
    def is_video(self) -> bool:
        """By the end of its name."""
        return self.path.suffix.lower() in VIDEO_SUFFIXES

    @property
    def relative(self) -> Path:
        """To the folder that was named."""
        return self.path.relative_to(self.root)

    def count(self, every: int) -> int:
        """How many pictures it is about, for a progress bar."""
        if not self.is_video:
            return 1
        with opened_video(self.path) as opened:
            return max(-(-int(opened.get(cv2.CAP_PROP_FRAME_COUNT)) // every), 1)

    def images(self, every: int) -> Iterator[tuple[str, UInt8Array]]:
        """Names and images (h, w, 3), RGB, as the camera was held; ``every``-th frames of a video.

        Raises DatasetError where it cannot be read.
        """
        if not self.is_video:
            yield str(self.path), read_image(self.path, upright=True)
            return
        index = None
        for index, image in images_of_video(self.path, every, upright=True):
            yield f"{self.path}#{index}", image
        if index is None:
            raise DatasetError(f"{self.path}: is no video that can be decoded; restore it, or convert it to MP4")


def find_pictures(paths: Sequence[Path], but_not: Path | None = None) -> list[PictureFile]:
    """The images and videos that are named, and those in the folders that are named and below; each once.

    Files whose name begins with a dot are other programs' notes, and count only where they are named. Nor
    does what lies in ``but_not``, a folder of copies inside one that is named.
    Raises UsageError for what is not there, is no file, is neither, or is a folder without any.
    """
    endings = SUFFIXES | VIDEO_SUFFIXES
    copies = None if but_not is None else but_not.resolve()
    found: dict[Path, PictureFile] = {}
    for path in paths:
        if path.is_dir():
            inside = sorted(one for one in path.rglob("[!.]*") if one.suffix.lower() in endings and one.is_file())
            if copies is not None and path.resolve() in copies.parents:
                inside = [one for one in inside if copies not in one.resolve().parents]
            if not inside:
                raise UsageError(f"{path}: has no images or videos; name the folder that they are in")
            for one in inside:
                found.setdefault(one.resolve(), PictureFile(one, path))
        elif not path.exists():
            raise UsageError(f"{path}: does not exist; name an image, a video or a folder")
        elif not path.is_file():
            raise UsageError(f"{path}: is not an ordinary file; name an image, a video or a folder")
        elif path.suffix.lower() not in endings:
            raise UsageError(
                f"{path}: is no image or video by its name; its name ends in one of {', '.join(sorted(endings))}"
            )
        else:
            found.setdefault(path.resolve(), PictureFile(path, path.parent))
    return list(found.values())


CATEGORY = "drone"
Size = Annotated[int, Field(ge=1)]


class _Part(BaseModel):
    """COCO has more keys than are used here."""

    model_config = ConfigDict(strict=True, extra="ignore", frozen=True, allow_inf_nan=False)


class _Image(_Part):
    id: int
    file_name: Annotated[str, Field(min_length=1)]
    width: Size | None = None
    height: Size | None = None


class _Category(_Part):
    id: int
    name: str


class _Annotation(_Part):
    image_id: int
    category_id: int
    bbox: tuple[float, float, Positive, Positive]
    """Left, top, width, height."""
    iscrowd: Literal[0] = 0
    """One box a drone."""


class _Coco(_Part):
    images: tuple[_Image, ...]
    annotations: tuple[_Annotation, ...]
    categories: tuple[_Category, ...]


@dataclass(frozen=True)
class PictureLabels:
    """The drones of one labelled picture."""

    boxes: tuple[Box, ...]
    size: tuple[int, int] | None
    """Width and height of the picture that was labelled; None: the file does not say."""


def read_labels(path: Path, pictures: Sequence[PictureFile]) -> dict[PictureFile, PictureLabels]:
    """The labelled ones of the pictures. Raises DatasetError, also where a labelled picture is not among them.

    A file name in the labels counts from the label file's folder, or from a folder that was given.
    """
    coco = _parsed(path)
    by_place = {picture.path.resolve(): picture for picture in pictures}
    folders = dict.fromkeys([path.parent.resolve(), *(one.root.resolve() for one in pictures)])
    labels: dict[PictureFile, PictureLabels] = {}
    drones = {category.id for category in coco.categories if category.name == CATEGORY}
    for image in coco.images:
        places = [place for folder in folders if (place := (folder / image.file_name).resolve()) in by_place]
        if not places:
            raise DatasetError(f"{path}: {image.file_name} is labelled and is not among the pictures; add it to them")
        if by_place[places[0]] in labels:
            raise DatasetError(f"{path}: {image.file_name} is in the images twice; delete one")
        mine = [one for one in coco.annotations if one.image_id == image.id and one.category_id in drones]
        boxes = tuple((left, top, left + width, top + height) for left, top, width, height in (a.bbox for a in mine))
        size = None if image.width is None or image.height is None else (image.width, image.height)
        labels[by_place[places[0]]] = PictureLabels(boxes, size)
    return labels


def check_size(path: Path, name: str, labels: PictureLabels, size: tuple[int, int]) -> None:
    """Raises DatasetError where the picture that was labelled had another width and height."""
    if labels.size is not None and labels.size != size:
        was, is_now = (" x ".join(map(str, one)) for one in (labels.size, size))
        raise DatasetError(f"{path}: {name} was {was} pixels when it was labelled and is {is_now}; label it again")


def _parsed(path: Path) -> _Coco:
    if path.exists() and not path.is_file():
        raise DatasetError(f"{path}: is not an ordinary file; name a COCO file with --labels")
    try:
        coco = _Coco.model_validate_json(path.read_bytes())
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); name a COCO file with --labels") from None
    except ValidationError as error:
        raise DatasetError(f"{path}: {_sentence(error)}") from None
    known = {"image": [image.id for image in coco.images], "category": [one.id for one in coco.categories]}
    for name, ids in known.items():
        doubled = [number for number, count in Counter(ids).items() if count > 1]
        if doubled:
            key = {"image": "images", "category": "categories"}[name]
            raise DatasetError(f"{path}: {key}: two have the id {doubled[0]}; give each its own")
        for k, one in enumerate(coco.annotations):
            value = getattr(one, f"{name}_id")
            if value not in ids:
                raise DatasetError(f"{path}: annotations[{k}].{name}_id: there is no {name} {value}; correct it")
    names = [category.name for category in coco.categories]
    if CATEGORY not in names:
        has = f"has {', '.join(names)}" if names else "is empty"
        raise DatasetError(f"{path}: categories: {has}, and the drones' must be named `{CATEGORY}`; rename or add it")
    return coco


def _sentence(error: ValidationError) -> str:
    """What is wrong first, at which key, and what to do."""
    first: Any = error.errors()[0]
    if first["type"] == "json_invalid":
        return f"is no JSON ({first['ctx']['error']}); name a COCO file with --labels"
    if not first["loc"]:
        return "is no COCO file; write images, annotations and categories"
    key = key_text(first["loc"])
    if first["type"] == "missing":
        return f"{key}: is missing; add it"
    return f"{key}: {first['msg'][0].lower() + first['msg'][1:]}, and not {first['input']!r:.60}; correct it"
