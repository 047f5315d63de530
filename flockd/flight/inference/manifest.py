"""A model's manifest: everything needed to feed its ONNX file and to interpret its outputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from flockd.core.choices import Provider, Role
from flockd.core.config.base import PlainName, Positive, Section, text
from flockd.core.errors import ModelError
from flockd.core.messages import Float32Array, FloatArray

Key = tuple[str | int, ...]
Fault = tuple[Key, str]
"""A fault of a manifest: its key, and a sentence that says what is wrong and what to do."""


class TensorSpec(Section):
    """One input or output of the network. A number in its shape is a fixed size, a word a free one."""

    shape: tuple[int | str, ...]
    meaning: Annotated[str, Field(min_length=1)]
    unit: Annotated[str, Field(min_length=1)]


class InputSpec(TensorSpec):
    """One input, and how an image becomes it: ``(grey level * white / 255 - mean) / deviation``, each channel."""

    dtype: Literal["uint8", "float32", "float16"]
    carries: str | None = None
    """Name of the input's content, such as `image`; by default the input's name."""
    kind: Literal["image", "planes"] = "image"
    """`planes` are numbers (n, c, h, w) that are not converted, one for `map_stride` pixels of the image."""
    layout: Literal["nhwc", "nchw"] = "nhwc"
    colour: Literal["rgb", "bgr", "grey"] = "rgb"
    white: Positive = 255.0
    """Value of the brightest grey level, 255; often 1."""
    mean: tuple[float, ...] = ()
    deviation: tuple[Positive, ...] = ()

    @property
    def image_size(self) -> tuple[int | str, int | str]:
        """Width and height of an image input."""
        height, width = self.shape[1:3] if self.layout == "nhwc" else self.shape[2:4]
        return width, height

    def faults(self) -> Iterator[Fault]:
        """Why no image can be converted to this input."""
        if len(self.shape) != 4:
            wanted = self.layout if self.kind == "image" else "nchw"
            yield ("shape",), f"has {len(self.shape)} axes; write the 4 of {wanted}"
            return
        if self.kind == "planes":
            if not isinstance(self.shape[1], int):
                yield ("shape", 1), f"{self.shape[1]} is not fixed; write how many planes there are"
            if self.dtype == "uint8":
                yield ("dtype",), "uint8 is for images; write float32 or float16 for planes"
            return
        channels = 1 if self.colour == "grey" else 3
        axis = 3 if self.layout == "nhwc" else 1
        if self.shape[axis] != channels:
            message = f"{self.shape[axis]} is not the {channels} of a {self.colour} image in {self.layout}"
            yield ("shape", axis), f"{message}; correct the shape, the colour or the layout"
        for key, values in (("mean", self.mean), ("deviation", self.deviation)):
            if values and len(values) != channels:
                yield (key,), f"has {len(values)} numbers for {channels} channels; write one for each channel"
        if self.dtype == "uint8" and (self.mean or self.deviation or self.white != 255.0):
            yield ("dtype",), "uint8 takes grey levels as they are; delete white, mean and deviation"


class DepthMeaning(Section):
    """Meaning of a depth output, which is metric."""

    quantity: Literal["depth", "inverse_depth"] = "depth"
    focal_px: Positive | None = None
    """Focal length in pixels of the input for which depth is metric; for other cameras it is scaled."""


class OutputSpec(TensorSpec):
    """One output of the network, and its statistics for the golden input."""

    dtype: Literal["float32", "float16"]
    gives: str | None = None
    """Name of the output's content, such as `flow`; by default the output's name."""
    layout: Literal["nhwc", "nchw"] = "nchw"
    """Layout of a map with 4 axes; with 3 it is (n, h, w)."""
    columns: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Names of the k numbers of an output (n, k), in their order."""
    factor: float = 1.0
    """Converts the output to pixels of the input (flow), pixels of the map (offset), metres or 1/m (depth)."""
    depth: DepthMeaning = DepthMeaning()
    golden_mean: float
    golden_deviation: float

    def by_column(self, values: Float32Array) -> dict[str, Float32Array]:
        """The columns (n,) of an output (n, k), by their names. Raises ValueError for an output of another shape."""
        if values.ndim != 2 or values.shape[1] != len(self.columns):
            raise ValueError(f"an output of shape {values.shape} does not have the columns {', '.join(self.columns)}")
        return {name: values[:, index] for index, name in enumerate(self.columns)}

    def faults(self) -> Iterator[Fault]:
        """Why the columns are impossible."""
        if not self.columns:
            return
        count = len(set(self.columns))
        if len(self.shape) != 2 or not self.shape[1] == len(self.columns) == count:
            message = f"has {count} different names for the shape {listed(self.shape)}; name each column of (n, k)"
            yield ("columns",), message


class CropSpec(Section):
    """How to cut a crop for a model: a square around the object, of a width that follows from the object's size.

    The numbers hold for every lens: the largest width is an angle. The smallest is in pixels of the camera's image, as
    its resolution limits it.
    """

    fill: Positive
    """For an object of known size: half the width of a crop over the object's size, both at the object's range."""
    first_margin: Positive
    """Half the width of the first crop over the distance from the centre of the object's box to its farthest corner."""
    cut_margin: Positive
    """The same if the image's border cuts the box: the object is larger than its visible part."""
    mirror_scale: Positive
    """Width of the last crop over the width that fits the object. The last crop is mirrored: the model's errors differ
    between the two, so their mean is better."""
    min_half_width_px: Positive
    """Half of a crop's width is at least this, in pixels of the camera's image: smaller objects stay small in it."""
    max_half_angle_deg: Annotated[float, Field(gt=0, lt=90)]
    """Largest half width, as an angle seen from the camera."""
    max_resize: Annotated[float, Field(gt=1)]
    """Largest factor by which the width changes from one crop to the next, wider or narrower."""
    max_crops: Annotated[int, Field(ge=2)]
    """Largest number of crops before the mirrored one: the first and the refined ones."""

    def fitting(self, size_m: FloatArray, range_m: FloatArray) -> FloatArray:
        """(n,) rad: half angles of the crops that fit objects of sizes and ranges (n,) m."""
        return np.asarray(np.arctan(self.fill * size_m / range_m))

    def bounded(self, half_angle: FloatArray, pixel_angle: FloatArray) -> FloatArray:
        """(n,) rad: half angles (n,) within the bounds. ``pixel_angle`` (n,): rad that a pixel of the image spans."""
        least = np.maximum(half_angle, self.min_half_width_px * pixel_angle)
        return np.minimum(least, np.radians(self.max_half_angle_deg))


class Manifest(Section):
    """All facts about one model."""

    name: PlainName
    roles: Annotated[tuple[Role, ...], Field(min_length=1)]
    """Roles that it can fill; `requirements` has what each requires."""
    file: Annotated[str, Field(min_length=1)]
    sha256: Annotated[str, text(r"^[0-9a-f]{64}$", "a SHA-256, 64 hexadecimal digits in small letters")]
    description: str
    image_scale: Positive = 1.0
    """Factor by which images are resized. For an input of fixed size they are resized to the largest that fits."""
    least_side_px: Annotated[int, Field(ge=0)] = 0
    """Least length of the shorter side after resizing; a smaller image is not resized."""
    size_multiple: Annotated[int, Field(ge=1)] = 1
    """The input's height and width are padded to a multiple of this."""
    map_stride: Annotated[int, Field(ge=1, le=64)] | None = None
    """Pixels of the input image per number of its planes, and per pixel of the output maps."""
    crop: CropSpec | None = None
    """How input crops are cut; None: the inputs are whole images."""
    thresholds: dict[str, float] = Field(default_factory=dict)
    """Decision thresholds of this model's outputs, by name; they belong to the weights."""
    inputs: Annotated[dict[str, InputSpec], Field(min_length=1)]
    outputs: Annotated[dict[str, OutputSpec], Field(min_length=1)]
    golden_size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
    """Width and height of the golden input image."""
    providers: tuple[Provider, ...] = ()
    """Providers that it was made for; empty: all."""
    licence: str
    data: str
    accuracy: dict[str, str]
    command: str
    """The command that made it."""

    @property
    def contents(self) -> Mapping[str, InputSpec]:
        """The inputs by their content."""
        return {spec.carries or name: spec for name, spec in self.inputs.items()}

    @property
    def results(self) -> Mapping[str, OutputSpec]:
        """The outputs by their content."""
        return {spec.gives or name: spec for name, spec in self.outputs.items()}

    @property
    def fixed_size(self) -> tuple[int, int] | None:
        """Width and height of the input images; None: the model takes any size."""
        width, height = next(spec.image_size for spec in self.inputs.values() if spec.kind == "image")
        return (width, height) if isinstance(width, int) and isinstance(height, int) else None

    @property
    def crop_size_px(self) -> int:
        """Width and height of the input crops. Raises ModelError if the inputs are whole images."""
        if self.crop is None or self.fixed_size is None:
            raise ModelError(f"model {self.name} takes no crops; choose one whose manifest has a section `crop`")
        return self.fixed_size[0]

    def faults(self) -> Iterator[Fault]:
        """Contradictions within the manifest, whatever the model is used for."""
        yield from _located(("inputs",), self.inputs)
        yield from _located(("outputs",), self.outputs)
        images = [spec for spec in self.inputs.values() if spec.kind == "image"]
        if not images:
            yield ("inputs",), "has no image; give one input `kind: image`"
            return
        if self.map_stride is None and len(images) < len(self.inputs):
            yield ("map_stride",), "is missing; write how many image pixels one number of the planes stands for"
        if self.crop is not None and (self.fixed_size is None or len(set(self.fixed_size)) > 1):
            yield ("crop",), "is for models whose image input is square and of a fixed size; delete it"


def _located(section: Key, specs: Mapping[str, InputSpec] | Mapping[str, OutputSpec]) -> Iterator[Fault]:
    for name, spec in specs.items():
        for key, message in spec.faults():
            yield (*section, name, *key), message


def listed(shape: tuple[int | str | None, ...] | list[int | str | None]) -> str:
    """A tensor's shape as people write it."""
    return "[" + ", ".join("?" if size is None else str(size) for size in shape) + "]"
