"""Boxes of drones from a COCO file (https://cocodataset.org/#format-data), refused where it cannot be meant."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flockd.core.config.base import Positive
from flockd.core.config.document import key_text
from flockd.ground.datasets.errors import DatasetError
from flockd.ground.pictures.picture_files import PictureFile
from flockd.ground.pictures.single_frame import Box

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
    iscrowd: Literal[0, 1] = 0


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
    by_place: dict[Path, PictureFile] = {}
    for picture in pictures:
        by_place[picture.path.resolve()] = picture
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
    images = {image.id for image in coco.images}
    categories = {category.id for category in coco.categories}
    for name, ids in (("images", coco.images), ("categories", coco.categories)):
        doubled = [number for number, count in Counter(one.id for one in ids).items() if count > 1]
        if doubled:
            raise DatasetError(f"{path}: {name}: two have the id {doubled[0]}; give each its own")
    for k, one in enumerate(coco.annotations):
        if one.image_id not in images:
            raise DatasetError(f"{path}: annotations[{k}].image_id: there is no image {one.image_id}; correct it")
        if one.category_id not in categories:
            message = f"there is no category {one.category_id}; correct it, or add it to categories"
            raise DatasetError(f"{path}: annotations[{k}].category_id: {message}")
        if one.iscrowd:
            raise DatasetError(f"{path}: annotations[{k}].iscrowd: is 1; give each drone a box of its own")
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
    message = first["msg"][0].lower() + first["msg"][1:]
    shown = json.dumps(first["input"], default=str)
    return f"{key}: {message}, and not {shown if len(shown) < 60 else f'{shown[:60]}...'}; correct it"
