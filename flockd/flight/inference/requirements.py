"""What each role requires of a model's manifest: inputs, outputs, columns, thresholds, crop."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from flockd.core.choices import Role
from flockd.flight.inference.manifest import Fault, Manifest

Bounds = tuple[float, float]
"""Least and largest value of a threshold, both included."""
_PROBABILITY: Bounds = (0.0, 1.0)
_POSITIVE: Bounds = (1e-6, 1.0)
_LOGIT: Bounds = (-50.0, 50.0)
"""Beyond them a float32 probability is 0 or 1."""
_LIMIT: Bounds = (0.0, 50.0)


@dataclass(frozen=True)
class Requirements:
    """Requirements of one role."""

    inputs: tuple[str, ...]
    """Meanings of its inputs."""
    outputs: Mapping[str, tuple[str, ...]]
    """Meanings of its outputs, and the columns required of an output (n, k), in any order."""
    optional_inputs: tuple[str, ...] = ()
    thresholds: Mapping[str, Bounds] = field(default_factory=dict)
    crop: bool = False
    """Whether the manifest has to define how crops are cut."""
    map_stride: bool = False


_GEOMETRY = ("geometry",)
"""Planes: tangents of the rays right and down, and inverse depth (1/m) of flat ground, 0 where unknown."""
_OF_CROPS = {
    "drone_probability": _PROBABILITY,  # from it on, a single picture is enough
    "another_crop_probability": _PROBABILITY,  # up to it, no further crop is examined
}
_OF_BOXES = ("centre_right_px", "centre_down_px", "width_px", "height_px", "drone_probability")
_OF_RANGES = ("log_range_per_focal", "right_px", "down_px", "log_relative_sigma", "drone_logit", "log_apparent_size")

REQUIREMENTS: Mapping[Role, Requirements] = {
    "flow": Requirements(inputs=("first", "second"), outputs={"flow": ()}),
    "depth": Requirements(inputs=("image",), outputs={"depth": ()}, optional_inputs=_GEOMETRY),
    "segmentation": Requirements(
        inputs=("image",),
        outputs={"drone": (), "offset": ()},
        optional_inputs=_GEOMETRY,
        thresholds={
            "proposal_logit": _LOGIT,  # pixels above it make proposals, which the second stage checks
        },
        map_stride=True,
    ),
    "detector": Requirements(
        inputs=("image",),
        outputs={"boxes": _OF_BOXES},
        thresholds={
            "box_probability": _POSITIVE,  # least probability of a proposed box
            "overlap": _PROBABILITY,  # largest intersection over union of two boxes
            "evidence_gain": _LIMIT,  # factor on a box's log odds before they are added to the second stage's
            "large_box_evidence": _LOGIT,  # log odds added for a box of 300 pixels and more, 0 up to 40
            "small_box_evidence": _LOGIT,  # log odds added for a box of 8 pixels and less, 0 from 20 on
            "no_box_evidence": _LOGIT,  # log odds added for a proposal of the segmentation alone
            "distance_logit_limit": _LIMIT,  # replaces that of `verification`
        },
    ),
    "distance": Requirements(
        inputs=("crop",),
        outputs={"range": _OF_RANGES},
        thresholds={
            **_OF_CROPS,
            "bearing_sigma_rad": _POSITIVE,  # standard deviation of a refined bearing, each way
            "min_relative_sigma": _PROBABILITY,  # least standard deviation of a range, as a share of it
            "mean_sigma_factor": _POSITIVE,  # sigma of the mean of two crops over that of one
        },
        crop=True,
    ),
    "verification": Requirements(
        inputs=("crop",),
        outputs={"drone": ("drone_logit",)},
        # The distance network's logit is added, between minus and plus this limit.
        thresholds={**_OF_CROPS, "distance_logit_limit": _LIMIT},
    ),
}
"""The table that a manifest is checked against. A distance model may give a `mask` (n, h, w) of logits as well."""


def check_roles(manifest: Manifest) -> Iterator[Fault]:
    """Faults of a manifest: what its roles require and it lacks, and inputs that no role knows."""
    for role in manifest.roles:
        yield from _faults_of_tensors(manifest, role, REQUIREMENTS[role])
        yield from _faults_of_numbers(manifest, role, REQUIREMENTS[role])
    yield from _unknown_to_all(manifest, [REQUIREMENTS[role] for role in manifest.roles])


def _faults_of_tensors(manifest: Manifest, role: Role, needed: Requirements) -> Iterator[Fault]:
    for content in needed.inputs:
        if content not in manifest.contents:
            message = f"the role {role} needs one that carries {content!r}; name it so, or set its `carries`"
            yield ("inputs",), message
    names = {spec.gives or name: name for name, spec in manifest.outputs.items()}
    for result, columns in needed.outputs.items():
        if result not in names:
            message = f"the role {role} needs one that gives {result!r}; name it so, or set its `gives`"
            yield ("outputs",), message
            continue
        for column in columns:
            if column not in manifest.results[result].columns:
                message = f"has no {column!r}; name the model's columns in their order, of which {role} needs "
                yield ("outputs", names[result], "columns"), message + ", ".join(columns)


def _faults_of_numbers(manifest: Manifest, role: Role, needed: Requirements) -> Iterator[Fault]:
    for name, (low, high) in needed.thresholds.items():
        value = manifest.thresholds.get(name)
        limits = f"a number from {low:g} to {high:g}"
        if value is None:
            yield ("thresholds", name), f"is missing for the role {role}; add it with {limits}"
        elif not low <= value <= high:
            yield ("thresholds", name), f"{value:g} is out of range; write {limits}"
    if needed.crop and manifest.crop is None:
        yield ("crop",), f"is missing for the role {role}; add a section that says how crops are cut out"
    if needed.map_stride and manifest.map_stride is None:
        yield ("map_stride",), f"is missing for the role {role}; write how many image pixels a map pixel spans"


def _unknown_to_all(manifest: Manifest, known: list[Requirements]) -> Iterator[Fault]:
    """Inputs that nothing would be fed to: most often a typing error."""
    inputs = {content for one in known for content in (*one.inputs, *one.optional_inputs)}
    for name, spec in manifest.inputs.items():
        content = spec.carries or name
        if content not in inputs:
            message = f"nothing is known to feed {content!r} with; set `carries` to one of {', '.join(sorted(inputs))}"
            yield ("inputs", name), message
        elif spec.kind != (wanted := "planes" if content in _GEOMETRY else "image"):
            yield ("inputs", name, "kind"), f"{spec.kind} does not fit {content!r}; write {wanted}"
