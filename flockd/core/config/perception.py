"""Which network or method fills which role, and what computes it."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from flockd.core import consistency, services
from flockd.core.choices import ROLES, FlowRefinement, HeightSource, Provider, Role, ScaleSource
from flockd.core.config.base import Distance, NonNegative, Positive, Section, Share, refuse

DIS, NO_MODEL = "dis", "none"
"""Stands in the place of a model's name: OpenCV's DIS flow, and no second stage."""

MIN_DRONE_SIZE_M, MAX_DRONE_SIZE_M = 0.05, 5.0
"""Limits of a drone's size from tip to tip: less is a toy that the networks do not find, more is an aircraft."""
MAX_SIZE_SIGMA = 0.3
"""Standard deviation of a known size as a share of it: with more, the networks' own judgement is better."""


class DetectionParameters(Section):
    """How networks' outputs become detections. What belongs to a network's weights stands in its manifest instead."""

    min_range_m: Distance = 0.2
    """A detection nearer than this is rejected: the two drones would touch."""
    max_range_m: Distance = 60.0
    """A detection farther than this is rejected: such a drone would be smaller than a pixel or two."""
    crop_shift: Share = 0.03
    """A further crop is not worth it when it would be moved by less than this share of half its width, ..."""
    crop_resize: Annotated[float, Field(ge=1)] = 1.05
    """... and resized by less than this factor."""
    suppression_gate: Positive = 3.4
    """Two detections are one when their Mahalanobis distance is less: 99 % of pairs of one drone are nearer (chi-square
    of three degrees of freedom)."""
    drone_extent: Share = 0.18
    """Standard deviation of a drone's centre between two of its detections, as a share of its size. With the gate, two
    drones are never nearer to each other than 0.6 of their size."""
    max_proposals: Annotated[int, Field(ge=1)] = 12
    """The most regions of one image that pass from the first stage to the second: those of the highest score, so that a
    cluttered image does not exceed the deadline. More than the drones that one camera sees."""
    mask_border_px: Annotated[int, Field(ge=0)] = 5
    """Background this near to a mask is not used: masks and depth maps are least certain there."""
    depth_map_sigma: Positive = 0.08
    """Standard deviation of a drone's log range where the depth map alone gives it (`perception.distance: none`)."""


class NoiseParameters(Section):
    """When an image counts as noise, and is not used. Lengths are of the image, and noise of its luminance."""

    level: Positive = 12.0
    """Standard deviation, in grey levels of 0-255, of white noise that matters; a camera at night has less."""
    whiteness: Share = 0.8
    """White noise is at the finest scale at least this strong as a share of the next; photographs have 0.3 to 0.6."""
    max_white: Share = 0.25
    """The image is not used where a larger share of it is white noise. 1, also of the rises below: all are used."""
    max_white_rise: Share = 0.08
    """The image is not used where the share of white noise exceeds that of the last half minute by this."""
    rough_level: Positive = 20.0
    """Strength, in grey levels, above which details at one of the finest scales count as rough."""
    max_rough_rise: Share = 0.4
    """The image is not used where the rough share exceeds that of the last half minute by this."""
    max_unexplained: Share = 0.35
    """The image is not used if a larger share of it than in the other cameras, by this much, cannot be predicted from
    the image before: it is damaged in blocks, or covered by soft noise. 1: all are used."""
    min_clarity: Share = 0.35
    """The image is not used if its ground has kept less than this share of the contrast or sharpness that the camera
    showed before, and the other cameras lost less. The lens is then covered, dirty, fogged or in the sun. 0: all are
    used."""
    clean_images: Annotated[int, Field(ge=1, le=100)] = 2
    """Clean images in a row before a camera that was noisy is used again."""


class RangeFinderParameters(Section):
    """When a range to the ground is used, and how the ground below is followed from ranges."""

    max_age_s: Annotated[float, Field(gt=0, le=5)] = services.GROUND_RANGE.timeout
    """An older reading is not used: the sensor has stopped."""
    min_quality: Share = 0.1
    """A reading with a weaker signal is not used, where the sensor reports its strength."""
    noise: Annotated[float, Field(gt=0, le=0.2)] = 0.02
    """Standard deviation of a range, as a share of it."""
    bridge_s: Annotated[float, Field(ge=0, le=10)] = 2.0
    """For this long after the last good reading the ground is expected where it was, with its slope."""
    gate_sigma: Positive = consistency.RANGE_GROUND.limit
    """A reading farther than this from the expected ground, in standard deviations, is of something else: a crate,
    another drone, a hole. The next one like it is used, unless it contradicts the height by the next three keys."""
    max_slope: Annotated[float, Field(ge=0, le=2)] = consistency.RANGE_SLOPE.limit
    """For each metre flown the ground rises or falls by no more than this."""
    tolerance_m: Annotated[float, Field(gt=0, le=100)] = consistency.RANGE_BAROMETER.limit
    """Added for a step in the ground, for the barometer's drift, and to `gate_sigma` of the range. A range finder whose
    readings and the barometer's height contradict each other by more is not used."""
    compare_s: Annotated[float, Field(gt=0, le=120)] = 15.0
    """Time in which the barometer may drift by `tolerance_m`. After a longer gap the ground is no longer known."""


class PerceptionConfig(Section):
    """Which model fills which role. A name is a manifest in `models_dir`, or a path to one that ends in `.yaml`.

    Relative paths count from the folder of the configuration file.
    """

    flow: str = "flow_int8"
    """`dis` is OpenCV's DIS flow instead of a network."""
    flow_refinement: FlowRefinement = "lucas_kanade"
    """A network's flow finds what moved far; this makes it exact. `lucas_kanade` is for flight: 4 ms an image.
    It follows points 16 px apart, and where the images show nothing, the surroundings determine the flow. `dis` takes
    34 ms, and each pixel keeps its own flow: for a sensor's depth, and images that are blurred and moved far.
    """
    depth: str = "neighbours_int8"
    segmentation: str = "neighbours_int8"
    detector: str = "detector"
    """Boxes of drones, found in the whole image. `none`: the segmentation alone proposes where a drone may be."""
    distance: str = "distance_int8"
    """Second stage: a drone's range from its crop alone. `none`: the depth map decides."""
    verification: str = "verification_int8"
    """Whether a crop of the second stage shows a drone at all. `none`: the distance network alone says so."""
    models_dir: str | None = None
    """Folder of the manifests; by default the one that comes with flockd."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
    """Of the networks. A drone's daemon computes as many of its cameras at once, and shares out what is left."""
    provider: Provider = "cpu"
    """What computes the networks. Another one than this is never used in its place, but `openvino` leaves crops to
    `cpu`."""
    engines_dir: str | None = None
    """Where `flockd models prepare` keeps what a provider has built; by default `engines` beside the manifests."""
    deadline_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """In flight, a network that has not finished one call by then is stuck, and is ended."""
    detection: DetectionParameters = DetectionParameters()
    noise: NoiseParameters = NoiseParameters()
    drone_size_m: Annotated[float, Field(ge=MIN_DRONE_SIZE_M, le=MAX_DRONE_SIZE_M)] | None = None
    """Size of every drone of the fleet, from tip to tip with propellers, where it is known: a drone's range is then
    this over its apparent size. By default the network estimates each drone's size, which is often wrong by a quarter
    for an airframe that it was not trained on."""
    drone_size_sigma_m: NonNegative = 0.01
    """Standard deviation of `drone_size_m`; the default is a tape measure's. It adds to the deviation of every
    range."""
    scale: ScaleSource = "height"
    """The background's metric scale: `network` (pure RGB, as in the paper) or `height` (attitude and height above
    ground from the autopilot)."""
    height: HeightSource = "barometer"
    """What measures the height for `scale: height`. `barometer`: the autopilot's height above home, so that the ground
    must be level. `range_finder`: a sensor that faces down; without a good reading there is no scale. `best`: the range
    finder, and while that gives nothing, the barometer."""
    range_finder: RangeFinderParameters = RangeFinderParameters()

    @model_validator(mode="after")
    def _a_known_size_is_of_use(self) -> Self:
        size = self.drone_size_m
        if size is None:
            return self
        faults: dict[tuple[str | int, ...], str] = {}
        if self.distance == NO_MODEL:
            faults["drone_size_m",] = "needs the apparent size, which a second stage gives; name one in `distance`"
        if self.drone_size_sigma_m > MAX_SIZE_SIGMA * size:
            faults["drone_size_sigma_m",] = (
                f"{self.drone_size_sigma_m:g} m is more than {MAX_SIZE_SIGMA:.0%} of drone_size_m, {size:g} m; "
                "measure it better, or delete both"
            )
        refuse(self, faults)
        return self

    @property
    def networks(self) -> dict[Role, str]:
        """The model's name, or its manifest's path, of each role that a network fills."""
        unused = {"detector", "verification"} if self.distance == NO_MODEL else set()
        names = {role: getattr(self, role) for role in ROLES if role not in unused}
        return {role: name for role, name in names.items() if name not in {DIS, NO_MODEL}}
