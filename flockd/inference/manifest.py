"""What a model file is: one YAML manifest beside each ONNX file, checked before anything runs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal, Self

import yaml
from pydantic import Field, ValidationError, model_validator

from flockd.config.base import Positive, Section
from flockd.config.perception import PerceptionConfig, Provider
from flockd.data import data_path
from flockd.errors import ModelError

Role = Literal["flow", "depth", "segmentation", "distance"]
Content = Literal["first", "second", "image", "geometry", "picture"]
"""What flockd can put into an input: the earlier and the later image of a pair, one image, its rays and flat ground
(see `Perception.scene`), the picture of one drone."""
Answer = Literal["flow", "depth", "drone", "offset", "range", "mask"]
"""What flockd can take from an output; the mask may be missing."""
Unknown = Literal["nothing", "scale", "scale_and_shift"]

_NEEDED: dict[Role, tuple[set[Content], set[Answer]]] = {
    "flow": ({"first", "second"}, {"flow"}),
    "depth": ({"image"}, {"depth"}),
    "segmentation": ({"image"}, {"drone", "offset"}),
    "distance": ({"picture"}, {"range"}),
}
_CHANNELS = {"rgb": 3, "bgr": 3, "grey": 1}


class TensorSpec(Section):
    """One input or output of the network. A number in its shape is fixed, a word is free."""

    shape: tuple[int | str, ...]
    meaning: Annotated[str, Field(min_length=1)]
    unit: Annotated[str, Field(min_length=1)]


class InputSpec(TensorSpec):
    """One input, and how an image becomes it: ``(grey level * white / 255 - mean) / deviation``, each channel."""

    dtype: Literal["uint8", "float32", "float16"]
    carries: Content | None = None
    """By default what the input's name says."""
    layout: Literal["nhwc", "nchw"] = "nhwc"
    colour: Literal["rgb", "bgr", "grey"] = "rgb"
    white: Positive = 255.0
    """What the brightest grey level, 255, becomes; often 1."""
    mean: tuple[float, ...] = ()
    deviation: tuple[Positive, ...] = ()

    @property
    def image_size(self) -> tuple[int | str, int | str]:
        """Width and height of an image input."""
        height, width = self.shape[1:3] if self.layout == "nhwc" else self.shape[2:4]
        return width, height

    def fault_as_image(self) -> str | None:
        """Why no image can become this, if so."""
        if len(self.shape) != 4:
            return f"shape: an image has 4 axes ({self.layout}), and not {len(self.shape)}"
        channels = _CHANNELS[self.colour]
        found = self.shape[3 if self.layout == "nhwc" else 1]
        if found != channels:
            return f"shape: a {self.colour} image in {self.layout} has {channels} where {found} is written"
        for key, values in (("mean", self.mean), ("deviation", self.deviation)):
            if values and len(values) != channels:
                return f"{key}: has {len(values)} numbers for {channels} channels"
        if self.dtype == "uint8" and (self.mean or self.deviation or self.white != 255.0):
            return "dtype: grey levels of uint8 enter as they are; leave white, mean and deviation out"
        return None


class DepthMeaning(Section):
    """What the numbers of a depth output say."""

    quantity: Literal["depth", "inverse_depth"] = "depth"
    unknown: Unknown = "nothing"
    """What the network cannot know. `perception.scale` then has to say what fixes it: `height` or `velocity`."""
    focal_px: Positive | None = None
    """Metric only for cameras of this focal length, in pixels of the input; others' depth is scaled by theirs."""


class OutputSpec(TensorSpec):
    """One output of the network, and how the golden input's answer is recognised."""

    dtype: Literal["float32", "float16"]
    gives: Answer | None = None
    """By default what the output's name says."""
    layout: Literal["nhwc", "nchw"] = "nchw"
    """Of a map with 4 axes; with 3 it is (n, h, w)."""
    factor: float = 1.0
    """Makes pixels of the input (flow), pixels of the map (offset), metres or 1/m (depth) of what comes out."""
    depth: DepthMeaning = DepthMeaning()
    golden_mean: float
    golden_deviation: float

    @property
    def map_size(self) -> tuple[int | str, ...]:
        """Width and height of a map."""
        axes = self.shape[1:3] if len(self.shape) == 3 or self.layout == "nhwc" else self.shape[2:4]
        return axes[::-1]


class Manifest(Section):
    """All that is known about one model."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]+$")]
    roles: Annotated[tuple[Role, ...], Field(min_length=1)]
    file: str
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    description: str
    image_scale: Positive = 1.0
    """The images are resized by this factor before they enter. A model of fixed size takes them as large as fits."""
    size_multiple: Annotated[int, Field(ge=1)] = 1
    """Height and width that enter are padded to a multiple of this."""
    inputs: dict[str, InputSpec]
    outputs: dict[str, OutputSpec]
    golden_size: tuple[int, int]
    """Width and height of the golden input image."""
    providers: tuple[Provider, ...] = ()
    """Those that it was made for; none: any."""
    licence: str
    data: str
    accuracy: dict[str, str]
    command: str
    """The command that made it."""

    @property
    def contents(self) -> dict[str, InputSpec]:
        """The inputs by what they carry."""
        return {spec.carries or name: spec for name, spec in self.inputs.items()}

    @property
    def answers(self) -> dict[str, OutputSpec]:
        """The outputs by what they give."""
        return {spec.gives or name: spec for name, spec in self.outputs.items()}

    @property
    def fixed_size(self) -> tuple[int, int] | None:
        """Width and height of the images that enter, if the model takes no other."""
        width, height = next(spec.image_size for content, spec in self.contents.items() if content != "geometry")
        return (width, height) if isinstance(width, int) and isinstance(height, int) else None

    @model_validator(mode="after")
    def _fills_its_roles(self) -> Self:
        allowed: set[str] = {"geometry"}
        for role in self.roles:
            contents, answers = _NEEDED[role]
            allowed |= contents
            for kind, missing in (("inputs", contents - set(self.contents)), ("outputs", answers - set(self.answers))):
                if missing:
                    verb = "carries" if kind == "inputs" else "gives"
                    raise ValueError(f"{kind}: the role {role} needs one that {verb} {sorted(missing)[0]!r}")
        for content, spec in self.contents.items():
            if content not in allowed:
                raise ValueError(f"inputs: nothing is known to put into {content!r}; `carries` has to say what it is")
            fault = spec.fault_as_image() if content != "geometry" else None
            if fault:
                raise ValueError(f"inputs: {content}: {fault}")
        mask = self.answers.get("mask")
        if "distance" in self.roles and mask and mask.map_size != self.contents["picture"].image_size:
            raise ValueError("outputs: mask: shape: has to be as high and wide as the picture that enters")
        return self


def load_manifest(path: Path) -> tuple[Manifest, Path]:
    """The manifest at ``path`` and its model file's path, hash checked; ``ModelError`` in one sentence otherwise."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ModelError(f"{path}: cannot read the model's manifest ({error.strerror}); name one that exists") from None
    try:
        manifest = Manifest.model_validate_json(
            json.dumps(yaml.safe_load(text))
        )  # JSON: lists may be tuples, all else strict
    except yaml.YAMLError as error:
        raise ModelError(f"{path}: not a YAML file ({str(error).splitlines()[0]}); restore the manifest") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        raise ModelError(
            f"{path}: {key}: {first['msg'].removeprefix('Value error, ')}; restore the manifest or mend this key"
        ) from None
    model = path.parent / manifest.file
    check_hash(manifest, model, path)
    return manifest, model


def check_hash(manifest: Manifest, model: Path, path: Path) -> None:
    """``ModelError`` when the model file is missing or differs from the manifest's SHA-256."""
    try:
        digest = hashlib.sha256(model.read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(
            f"{path}: file: cannot read {model} ({error.strerror}); put the model file back or name the right one"
        ) from None
    if digest != manifest.sha256:
        raise ModelError(
            f"{path}: sha256: {model} has {digest[:12]}... and not {manifest.sha256[:12]}..., so the model file was "
            "changed or damaged; restore it, or export it again with its manifest"
        )


def models_folder(config: PerceptionConfig) -> Path:
    """Where a configuration's models are known by their names: its own folder, else the one that comes with flockd.

    Raises ModelError when its own is not there.
    """
    if config.models_dir is None:
        return data_path("models")
    folder = Path(config.models_dir)
    if not folder.is_dir():
        raise ModelError(f"perception.models_dir: {folder} is no folder; name the one that holds the models' manifests")
    return folder


def manifest_path(folder: Path, name: str) -> Path:
    """Of a model by its name in a folder, or of one that is named by its manifest's path."""
    return Path(name) if name.endswith(".yaml") else folder / f"{name}.yaml"


def manifests_of(config: PerceptionConfig) -> tuple[Path, ...]:
    """The manifests of all models that a configuration names, each once. Raises ModelError for a missing folder."""
    names = (config.flow, config.depth, config.segmentation, config.distance)
    folder = models_folder(config)
    return tuple(dict.fromkeys(manifest_path(folder, name) for name in names if name not in {"dis", "none"}))


def find_manifests(folder: Path) -> tuple[Path, ...]:
    """All manifests in a folder, by name."""
    return tuple(sorted(folder.glob("*.yaml")))
