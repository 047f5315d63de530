"""What one model is: all that has to be known of its ONNX file to feed it and to read what comes out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flockd.core.choices import Provider
from flockd.core.config.base import PlainName, Positive, Section, text
from flockd.core.errors import ModelError
from flockd.core.messages import Float32Array

Unknown = Literal["nothing", "scale", "scale_and_shift"]
Key = tuple[str | int, ...]

_CHANNELS = {"rgb": 3, "bgr": 3, "grey": 1}


@dataclass(frozen=True)
class Fault:
    """One thing wrong with a manifest: at which key, and a sentence that says what, and what to do."""

    key: Key
    message: str


class TensorSpec(Section):
    """One input or output of the network. A number in its shape is fixed, a word is free."""

    shape: tuple[int | str, ...]
    meaning: Annotated[str, Field(min_length=1)]
    unit: Annotated[str, Field(min_length=1)]


class InputSpec(TensorSpec):
    """One input, and how an image becomes it: ``(grey level * white / 255 - mean) / deviation``, each channel."""

    dtype: Literal["uint8", "float32", "float16"]
    carries: str | None = None
    """What it is fed with; by default what the input's name says."""
    kind: Literal["image", "planes"] = "image"
    """`planes` are (n, c, h, w) numbers that are fed as they are, at `map_stride` image pixels a number."""
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

    def faults(self) -> Iterator[Fault]:
        """Why nothing can become this."""
        if len(self.shape) != 4:
            wanted = self.layout if self.kind == "image" else "nchw"
            yield Fault(("shape",), f"has {len(self.shape)} axes; write the 4 of {wanted}")
            return
        if self.kind == "planes":
            if not isinstance(self.shape[1], int):
                yield Fault(("shape", 1), f"{self.shape[1]} is not fixed; write how many planes there are")
            if self.dtype == "uint8":
                yield Fault(("dtype",), "uint8 is for images; write float32 or float16 for planes")
            return
        channels = _CHANNELS[self.colour]
        axis = 3 if self.layout == "nhwc" else 1
        if self.shape[axis] != channels:
            message = f"{self.shape[axis]} is not the {channels} of a {self.colour} image in {self.layout}"
            yield Fault(("shape", axis), f"{message}; correct the shape, the colour or the layout")
        for key, values in (("mean", self.mean), ("deviation", self.deviation)):
            if values and len(values) != channels:
                yield Fault((key,), f"has {len(values)} numbers for {channels} channels; write one for each channel")
        if self.dtype == "uint8" and (self.mean or self.deviation or self.white != 255.0):
            yield Fault(("dtype",), "uint8 takes grey levels as they are; delete white, mean and deviation")


class DepthMeaning(Section):
    """What the numbers of a depth output say."""

    quantity: Literal["depth", "inverse_depth"] = "depth"
    unknown: Unknown = "nothing"
    """What the network cannot know. `perception.scale` then has to be `height`, which fixes it."""
    focal_px: Positive | None = None
    """Metric only for cameras of this focal length, in pixels of the input; others' depth is scaled by theirs."""


class OutputSpec(TensorSpec):
    """One output of the network, and what it is for the golden input."""

    dtype: Literal["float32", "float16"]
    gives: str | None = None
    """What it is used as; by default what the output's name says."""
    layout: Literal["nhwc", "nchw"] = "nchw"
    """Layout of a map with 4 axes; with 3 it is (n, h, w)."""
    columns: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Names of the k numbers of an output (n, k), in their order."""
    factor: float = 1.0
    """Makes pixels of the input (flow), pixels of the map (offset), metres or 1/m (depth) of what comes out."""
    depth: DepthMeaning = DepthMeaning()
    golden_mean: float
    golden_deviation: float

    def by_column(self, values: Float32Array) -> dict[str, Float32Array]:
        """The columns (n,) of an output (n, k), by their names. Raises ValueError for an output of another shape."""
        if values.ndim != 2 or values.shape[1] != len(self.columns):
            raise ValueError(f"an output of shape {values.shape} has not the columns {', '.join(self.columns)}")
        return {name: values[:, index] for index, name in enumerate(self.columns)}

    def faults(self) -> Iterator[Fault]:
        """Why the columns cannot be."""
        if not self.columns:
            return
        doubled = sorted({name for name in self.columns if self.columns.count(name) > 1})
        if doubled:
            yield Fault(("columns",), f"names {doubled[0]!r} twice; give each column its own name")
        if len(self.shape) != 2 or self.shape[1] != len(self.columns):
            message = f"has {len(self.columns)} names for the shape {listed(self.shape)}; name each column of (n, k)"
            yield Fault(("columns",), message)


class CropSpec(Section):
    """How to cut a crop for a model: a square with the object in the middle, at a certain size.

    The same numbers serve lenses of any kind and length: the greatest width is an angle, the least is in pixels of the
    camera's image, whose sharpness it is about.
    """

    fill: Positive
    """Half of a crop's width over the object's size, both at the object's range; for an object of known size."""
    first_margin: Positive
    """Half of the first crop's width, over the way from the centre of the object's box to its farthest corner."""
    cut_margin: Positive
    """The same where the box is cut off by the image's border: the object is larger than what is seen of it."""
    mirror_scale: Positive
    """Width of the last crop, over the width that suits the object. It enters mirrored: the model errs on it in another
    way, and so the mean of both errs less."""
    min_half_width_px: Positive
    """Half of a crop's width is at least this, in pixels of the camera's image: smaller objects stay small in it."""
    max_half_angle_deg: Annotated[float, Field(gt=0, lt=90)]
    """And at most this, seen from the camera."""
    max_resize: Annotated[float, Field(gt=1)]
    """A further crop is at most this many times as wide as the one before it, and at least as much narrower."""
    max_crops: Annotated[int, Field(ge=2)]
    """How often an object is cropped anew before the mirrored crop, at most: the first crop and the refined ones."""


class Manifest(Section):
    """All that is known about one model."""

    name: PlainName
    roles: Annotated[tuple[str, ...], Field(min_length=1)]
    """What it can be used for; who uses it knows what each role needs."""
    file: Annotated[str, Field(min_length=1)]
    sha256: Annotated[str, text(r"^[0-9a-f]{64}$", "a SHA-256, 64 hexadecimal digits in small letters")]
    description: str
    image_scale: Positive = 1.0
    """The images are resized by this factor before they enter. A model of fixed size takes them as large as fits."""
    least_side_px: Annotated[int, Field(ge=0)] = 0
    """The shorter side enters with so many pixels at least, as far as the image has them."""
    size_multiple: Annotated[int, Field(ge=1)] = 1
    """Height and width that enter are padded to a multiple of this."""
    map_stride: Annotated[int, Field(ge=1, le=64)] | None = None
    """Pixels of the image that enters per number of its planes, and per pixel of the maps that come out."""
    crop: CropSpec | None = None
    """How the crop that enters is to be cut out; None: whole images enter."""
    thresholds: dict[str, float] = Field(default_factory=dict)
    """Decision thresholds of this model's outputs, by name; they belong to the weights."""
    inputs: Annotated[dict[str, InputSpec], Field(min_length=1)]
    outputs: Annotated[dict[str, OutputSpec], Field(min_length=1)]
    golden_size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
    """Width and height of the golden input image."""
    providers: tuple[Provider, ...] = ()
    """Those that it was made for; none: any."""
    licence: str
    data: str
    accuracy: dict[str, str]
    command: str
    """The command that made it."""

    @property
    def contents(self) -> Mapping[str, InputSpec]:
        """The inputs by what they carry."""
        return {spec.carries or name: spec for name, spec in self.inputs.items()}

    @property
    def results(self) -> Mapping[str, OutputSpec]:
        """The outputs by what they give."""
        return {spec.gives or name: spec for name, spec in self.outputs.items()}

    @property
    def fixed_size(self) -> tuple[int, int] | None:
        """Width and height of the images that enter, if the model takes no other."""
        width, height = next(spec.image_size for spec in self.inputs.values() if spec.kind == "image")
        return (width, height) if isinstance(width, int) and isinstance(height, int) else None

    @property
    def crop_size_px(self) -> int:
        """Width and height of the crop that enters. Raises ModelError where whole images enter."""
        if self.crop is None or self.fixed_size is None:
            raise ModelError(f"model {self.name} takes no crops; choose one whose manifest has a section `crop`")
        return self.fixed_size[0]

    def threshold(self, name: str) -> float:
        """One number by which the outputs are judged. Raises ModelError where the manifest has none of that name."""
        if name not in self.thresholds:
            raise ModelError(f"model {self.name} has no thresholds.{name}; add it to its manifest")
        return self.thresholds[name]

    def faults(self) -> Iterator[Fault]:
        """What does not fit together, whatever the model is used for."""
        yield from _located(("inputs",), self.inputs)
        yield from _located(("outputs",), self.outputs)
        images = [spec for spec in self.inputs.values() if spec.kind == "image"]
        if not images:
            yield Fault(("inputs",), "has no image; give one input `kind: image`")
        for kind, names in (
            ("carries", [spec.carries or name for name, spec in self.inputs.items()]),
            ("gives", [spec.gives or name for name, spec in self.outputs.items()]),
        ):
            doubled = sorted({name for name in names if names.count(name) > 1})
            if doubled:
                section = "inputs" if kind == "carries" else "outputs"
                yield Fault((section,), f"has two of which each {kind} {doubled[0]!r}; correct `{kind}` of one")
        if self.map_stride is None and len(images) < len(self.inputs):
            yield Fault(("map_stride",), "is missing; write how many image pixels one number of the planes stands for")
        if self.crop is not None and any(len(set(spec.image_size)) > 1 or not _is_fixed(spec) for spec in images):
            yield Fault(("crop",), "is for models whose image input is square and of a fixed size; delete it")


def _located(section: Key, specs: Mapping[str, InputSpec] | Mapping[str, OutputSpec]) -> Iterator[Fault]:
    for name, spec in specs.items():
        for fault in spec.faults():
            yield Fault((*section, name, *fault.key), fault.message)


def _is_fixed(spec: InputSpec) -> bool:
    return all(isinstance(size, int) for size in spec.image_size)


def listed(shape: tuple[int | str | None, ...] | list[int | str | None]) -> str:
    """A tensor's shape as people write it."""
    return "[" + ", ".join("?" if size is None else str(size) for size in shape) + "]"


def golden_deviates(spec: OutputSpec, values: NDArray[np.floating], tolerance: float) -> str | None:
    """How an output for the golden input differs from the manifest's, or None where it does not."""
    mean, deviation = float(values.mean()), float(values.std())
    allowed = tolerance * (abs(spec.golden_mean) + spec.golden_deviation) + 1e-6
    if abs(mean - spec.golden_mean) <= allowed and abs(deviation - spec.golden_deviation) <= allowed:
        return None
    return (
        f"the golden input gives mean {mean:.4g} and deviation {deviation:.4g} where {spec.golden_mean:.4g} and "
        f"{spec.golden_deviation:.4g} are expected"
    )
