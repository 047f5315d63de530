"""Which network or method fills which role, and what computes it."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from flockd.core import consistency, services
from flockd.core.choices import ROLES, FlowRefinement, HeightSource, Provider, Role, ScaleSource
from flockd.core.config.base import Distance, NonNegative, Positive, Section, Share, refuse

DIS, NO_MODEL = "dis", "none"
"""Stand in the place of a model's name: OpenCV's DIS flow, and no network."""

MIN_DRONE_SIZE_M, MAX_DRONE_SIZE_M = 0.05, 5.0
"""Limits of a drone's size from tip to tip: less is a toy that the networks do not find, more is an aircraft."""
MAX_SIZE_SIGMA = 0.3
"""Standard deviation of a known size as a share of it: with more, the networks' own judgement is better."""


class DetectionParameters(Section):
    """From the networks' outputs to detections. Values that belong to a network's weights stand in its manifest."""

    min_range_m: Distance = 0.2
    """A nearer detection is rejected: the two drones would touch."""
    max_range_m: Distance = 60.0
    """A farther detection is rejected: such a drone is only a pixel or two wide."""
    crop_shift: Share = 0.03
    """No further crop is made if it would move by less than this share of half its width, ..."""
    crop_resize: Annotated[float, Field(ge=1)] = 1.05
    """... and change its size by less than this factor."""
    suppression_gate: Positive = 3.4
    """Mahalanobis distance below which two detections are of one drone; 99 % of pairs of one drone are nearer
    (chi-square with three degrees of freedom)."""
    drone_extent: Share = 0.18
    """Standard deviation of the centre between two detections of one drone, as a share of its size. With this gate,
    detections within 0.6 of a drone's size are always merged."""
    max_proposals: Annotated[int, Field(ge=1)] = 12
    """Largest number of proposals of one image for the second stage, those of the highest scores, so that a cluttered
    image does not exceed the deadline. It must be above the number of drones that one camera sees."""
    mask_border_px: Annotated[int, Field(ge=0)] = 5
    """Border around masks in which background is not used, because masks and depth maps are uncertain there."""


class NoiseParameters(Section):
    """Conditions under which an image counts as noise and is not used."""

    level: Positive = 12.0
    """Standard deviation, in grey levels of 0-255, of white noise that matters; a camera at night has less."""
    whiteness: Share = 0.8
    """Least strength of white noise at the finest scale as a share of the next scale's; photographs have 0.3 to 0.6."""
    max_white: Share = 0.25
    """Largest share of white noise in an image that is used. 1 here, or in the three limits below: no limit."""
    max_white_rise: Share = 0.08
    """Largest increase of that share over the last half minute."""
    rough_level: Positive = 20.0
    """Strength, in grey levels, above which details at one of the finest scales count as rough."""
    max_rough_rise: Share = 0.4
    """Largest increase of the rough share over the last half minute."""
    max_unexplained: Share = 0.35
    """Largest share of an image, above that of the other cameras, that cannot be predicted from the image before. More
    is damage in blocks, or soft noise. 1: no limit."""
    min_clarity: Share = 0.35
    """Least share of the earlier contrast and sharpness of the ground, if the other cameras lost less. Below it the
    lens is covered, dirty, fogged or in the sun, and the image is not used. 0: no limit."""
    clean_images: Annotated[int, Field(ge=1, le=100)] = 2
    """Number of clean images in a row after which a noisy camera is used again."""


class RangeFinderParameters(Section):
    """Conditions for using a range to the ground, and the filter of the ground below."""

    max_age_s: Annotated[float, Field(gt=0, le=5)] = services.GROUND_RANGE.timeout
    """Largest age of a reading; the sensor has stopped if it is older."""
    min_quality: Share = 0.1
    """Least signal quality of a reading, if the sensor reports it."""
    noise: Annotated[float, Field(gt=0, le=0.2)] = 0.02
    """Standard deviation of a range, as a share of the range."""
    bridge_s: Annotated[float, Field(ge=0, le=10)] = 2.0
    """Time after the last good reading for which the ground is extrapolated with its slope."""
    gate_sigma: Positive = consistency.RANGE_GROUND.limit
    """Largest distance of a reading from the expected ground, in standard deviations. One farther reading is not used:
    it may be of a crate or a drone. The next one is used, unless it contradicts the height by the next three keys."""
    max_slope: Annotated[float, Field(ge=0, le=2)] = consistency.RANGE_SLOPE.limit
    """Steepest slope of the ground."""
    tolerance_m: Annotated[float, Field(gt=0, le=100)] = consistency.RANGE_BAROMETER.limit
    """Allowance for a step of the ground and for the barometer's drift. A range finder that contradicts the barometer's
    height by more than this, the slope and `gate_sigma` is not used."""
    compare_s: Annotated[float, Field(gt=0, le=120)] = 15.0
    """Time in which the barometer may drift by `tolerance_m`. After a longer gap of readings the ground is unknown."""


class PerceptionConfig(Section):
    """Which model fills which role. A name is a manifest in `models_dir`, or a path to one that ends in `.yaml`.

    Relative paths count from the folder of the configuration file.
    """

    flow: str = "flow_int8"
    """Optical flow; `dis` is OpenCV's DIS instead of a network."""
    flow_refinement: FlowRefinement = "lucas_kanade"
    """Refinement of a network's flow, which finds large displacements. `lucas_kanade` is for flight: it takes 4 ms an
    image, tracks points 16 px apart, and fills areas without texture from their surroundings. `dis` takes 34 ms and
    refines each pixel: for a depth sensor, and for blurred images with large displacements.
    """
    depth: str = "neighbours_int8"
    segmentation: str = "neighbours_int8"
    detector: str = "detector"
    """Boxes of drones in the whole image. `none`: only the segmentation makes proposals."""
    distance: str = "distance_int8"
    """Second stage: a drone's range from its crop."""
    verification: str = "verification_int8"
    """Second stage: the probability that a crop shows a drone. `none`: it comes from the distance network alone."""
    models_dir: str | None = None
    """Folder of the manifests; by default the one that comes with flockd."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
    """Threads for the networks. The daemon processes this many cameras in parallel, or one with several threads."""
    provider: Provider = "cpu"
    """Provider that computes the networks. flockd never changes to another one, but `openvino` leaves crops to
    `cpu`."""
    engines_dir: str | None = None
    """Folder for the engines that `flockd models prepare` builds; by default `engines` beside the manifests."""
    deadline_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """Longest time of a network call in flight; a longer one is ended."""
    longest_rest_s: Annotated[float, Field(ge=0, le=1)] = 0.5
    """At steps of half this time and less, a camera rests for at most this time, unless it looks where the drone flies
    or has a neighbour in view. 0, or with `obstacles.enabled`: no camera rests."""
    detection: DetectionParameters = DetectionParameters()
    noise: NoiseParameters = NoiseParameters()
    drone_size_m: Annotated[float, Field(ge=MIN_DRONE_SIZE_M, le=MAX_DRONE_SIZE_M)] | None = None
    """Size of every drone of the fleet, from tip to tip with propellers. A drone's range is this over its apparent
    size. By default the network estimates it, often wrong by a quarter for an airframe that it was not trained on."""
    drone_size_sigma_m: NonNegative = 0.01
    """Standard deviation of `drone_size_m`, by default that of a tape measure. It adds to that of every range."""
    scale: ScaleSource = "height"
    """Source of the background's metric scale: `network` (images, as in the paper) or `height` (the autopilot's)."""
    height: HeightSource = "barometer"
    """Source of the height for `scale: height`. `barometer`: the autopilot's height above home, for level ground only.
    `range_finder`: a sensor that faces down; without a good reading there is no scale. `best`: the range finder, or the
    barometer while the range finder gives no good reading."""
    range_finder: RangeFinderParameters = RangeFinderParameters()

    @model_validator(mode="after")
    def _a_known_size_is_of_use(self) -> Self:
        size = self.drone_size_m
        if size is None:
            return self
        faults: dict[tuple[str | int, ...], str] = {}
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
        names = {role: getattr(self, role) for role in ROLES}
        return {role: name for role, name in names.items() if name not in {DIS, NO_MODEL}}
