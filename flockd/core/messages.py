"""The data types that pass from images to command. Frozen; a receiver never changes an array.

Frames: camera optical (RDF), body (FRD), world (NED). ``R_a_b`` takes coordinates from b to a: ``p_a = R_a_b @ p_b``.
Pixels are (u, v) with pixel centres at +0.5. Times are seconds on a monotonic clock, never wall time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flockd.core.navigation import wrapped

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
UInt8Array = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Shape:
    """Shape of an array in a message, in its annotation: recordings are checked against it."""

    sizes: tuple[int, ...]


Vector2 = Annotated[FloatArray, Shape((2,))]
Vector3 = Annotated[FloatArray, Shape((3,))]
Matrix3 = Annotated[FloatArray, Shape((3, 3))]


class ReasonKind(StrEnum):
    """What a reason says is missing from a step."""

    INPUT = "input"
    """All of it: the frames or the vehicle state cannot be right."""
    HEIGHT = "height"
    """The height's wanted source."""
    CAMERA = "camera"
    """A camera's image, or part of what perception makes of it."""
    LENS = "lens"
    """A camera's image, as its lens shows too little."""
    PAIR = "pair"
    """The pair of frame sets."""
    PROPOSAL = "proposal"
    """A region that may show a drone."""
    EGO_MOTION = "ego_motion"
    NEIGHBOUR = "neighbour"
    """A neighbour, or its motion."""
    RIG = "rig"
    """A camera's image, as it moves otherwise than the drone."""
    RECORDED = "recorded"
    """Unknown: recordings keep the text alone."""


@dataclass(frozen=True)
class Reason:
    """Why a step lacks something."""

    kind: ReasonKind
    text: str
    """One short sentence, the same for each occurrence; for people."""

    def __str__(self) -> str:
        return self.text


UNCLASSED = 255
"""Label of pixels that are not to be used: too near a drone's outline to be sure of, or a drone's that is not detected.
Other labels are 0 for the background, then one value a drone."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of one camera."""

    camera: str
    image: UInt8Array
    """(height, width, 3) RGB."""
    time_s: float
    sequence: int


@dataclass(frozen=True, eq=False)
class FrameSet:
    """The images of all cameras of one drone at one time; a camera that has failed is absent."""

    time_s: float
    frames: Mapping[str, Frame]


@dataclass(frozen=True, eq=False)
class RangeReading:
    """How far a range finder that faces down says the ground is."""

    time_s: float
    """When it was measured, on the clock of `VehicleState`."""
    range_m: float
    """Along the body's down axis."""
    min_m: float | None = None
    """Nearer than this the sensor measures nothing; None: not known."""
    max_m: float | None = None
    """Farther than this, likewise."""
    quality: float | None = None
    """Quality of the signal, 0 (none) to 1; None: the sensor does not say."""


@dataclass(frozen=True, eq=False)
class VehicleState:
    """What the drone's own autopilot says of itself. Nothing in here comes from another drone."""

    time_s: float
    R_ned_body: Matrix3
    """(3, 3) attitude."""
    height_m: float
    """Height above home from the barometer, metres, up positive: above the ground where that is level."""
    velocity_ned: Vector3 | None = None
    """(3,) m/s, the autopilot's own estimate, where it has one."""
    position: Vector2 | None = None
    """(2,) metres north and east of home, the autopilot's own estimate, where it has one."""
    home_deg: Vector2 | None = None
    """(2,) latitude and longitude of home, where the autopilot knows it."""
    ground_range: RangeReading | None = None
    """The newest of the range finder that faces down, however old or bad; None: none was heard."""
    turn_rate: Vector3 | None = None
    """(3,) rad/s about the body axes, where it is known."""


@dataclass(frozen=True, eq=False)
class GroundEstimate:
    """The ground below the drone, as a plane: what fixed the metric scale of depth."""

    height_m: float
    """Height of the body's origin above the ground straight below."""
    slope: Vector2
    """(2,) rise of the ground for each metre to the north and to the east."""
    source: str
    """`range_finder` or `barometer`."""


@dataclass(frozen=True, eq=False)
class MissionOrder:
    """What an operator asks of one drone's mission: a goal, in metres or in degrees, or a velocity."""

    place: Vector2 | None = None
    """(2,) metres north and east of the mission's origin."""
    place_deg: Vector2 | None = None
    """(2,) latitude and longitude."""
    velocity: Vector2 | None = None
    """(2,) m/s, north and east."""
    height_m: float | None = None
    """Above the ground at home; None: as before."""
    speed_m_s: float | None = None
    """On the way to the goal; None: the mission's."""


@dataclass(frozen=True, eq=False)
class MissionStatus:
    """How far a drone is with its mission."""

    kind: str
    desired: Vector2
    """(2,) m/s: W_i efv of Eq. 42, less flocking's own weight."""
    sentence: str
    """What it does now, for people."""
    goal: Vector2 | None = None
    """(2,) metres north and east of home: where it flies to; None: nowhere in particular."""
    goal_height_m: float | None = None
    arrived: bool = False
    """At the last goal."""
    takeover: str | None = None
    """`land` or `return`: what the autopilot is to be asked for, as the mission is over; None: nothing."""

    @property
    def known(self) -> bool:
        """Whether a mission has reported it."""
        return self.kind != NO_STATUS.kind


NO_STATUS = MissionStatus("unknown", np.zeros(2), "has not begun")
"""Before a pilot's first good step, of one that was not stepped, and in recordings that do not hold the circle's."""


@dataclass(frozen=True, eq=False)
class EgoMotion:
    """The drone's own motion over one interval: ``P_C = rotation @ P_F + translation`` (Eq. 7).

    C is the body frame at the interval's start, F at its end.
    """

    rotation: Matrix3
    """(3, 3)"""
    translation: Vector3
    """(3,) metres, in C."""
    interval_s: float
    pairs: int
    inliers: int
    threshold_m: float
    """The rejection threshold at which Algorithm 1 found its inliers."""

    @property
    def velocity(self) -> FloatArray:
        """(3,) m/s in C, the mean over the interval (Eq. 21)."""
        return self.translation / self.interval_s


@dataclass(frozen=True, eq=False)
class Detection:
    """One drone detected in one frame set, before tracking, in log-polar coordinates: a bearing and a log range.

    Cameras err in these independently: in direction by an angle, in range by a share of it.
    """

    bearing: Vector3
    """(3,) unit vector towards the drone's centre, body FRD of the frame set."""
    log_range: float
    """Natural logarithm of the range in metres."""
    covariance: Matrix3
    """(3, 3) in body axes, of what `flockd.flight.geometry.log_polar_residual` measures: along the bearing the
    variance of the log range, if the size is right; across it that of the angle, rad^2."""
    drone_probability: float
    """Probability that it is a drone at all."""
    size_m: float
    """An estimate of the drone's own size, constant over time: its range times its angular size."""
    cameras: tuple[str, ...]
    """More than one where the drone straddles an image border."""
    label: int
    """Its value in the masks of this frame set, from 1 up."""
    log_size_sigma: float = 0.0
    """Standard deviation of the logarithm of `size_m`: the log range has the same error, alike in all of a drone's."""

    @property
    def range_m(self) -> float:
        """From the body's origin."""
        return math.exp(self.log_range)

    @property
    def position(self) -> FloatArray:
        """(3,) metres, body FRD of the frame set."""
        return self.range_m * self.bearing

    @property
    def range_sigma_m(self) -> float:
        """Standard deviation along the line of sight, to first order."""
        return math.hypot(self.way_sigma_m, self.range_m * self.log_size_sigma)

    @property
    def way_sigma_m(self) -> float:
        """The same if the size is right: of the distance that the drone flew between two detections of it."""
        return self.range_m * math.sqrt(float(self.bearing @ self.covariance @ self.bearing))


SECTORS = 72
"""Directions of `ObstacleRanges`: one every 5 degrees."""

Sectors = Annotated[FloatArray, Shape((SECTORS,))]


@dataclass(frozen=True, eq=False)
class ObstacleRanges:
    """Nearest obstacle in each of n equal sectors around the drone, level, over the heights that the drone needs.

    Sector k is centred on the azimuth 2 pi k / n, clockwise from north.
    """

    time_s: float
    range_m: Sectors
    """(n,) metres, level, from the drone's centre; inf where nothing was seen within `seen_m`."""
    sigma_m: Sectors
    """(n,) metres: standard deviation of `range_m`; 0 where that is inf."""
    seen_m: Sectors
    """(n,) metres: how far the sector is known to be free or measured; 0 where it was not looked at."""


@dataclass(frozen=True, eq=False)
class PossibleMotion:
    """One of the ways in which a neighbour may move, by its detections."""

    probability: float
    """That it is the true one; those of a neighbour add up to 1."""
    position: Vector3
    velocity: Vector3
    """As of `Neighbour`."""
    range_sigma_m: float
    """Standard deviation of the position along the line of sight, ..."""
    closing_sigma_m_s: float
    """... and of the velocity."""


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A tracked drone, in level axes that point north, east and down, relative to the own drone."""

    track: int
    position: Vector3
    """(3,) metres, NED, own drone at the origin, at the output's time."""
    velocity: Vector3
    """(3,) m/s, NED, over ground."""
    position_sigma_m: float
    velocity_sigma_m_s: float
    age_s: float
    """Since first seen."""
    unseen_s: float
    """Since last seen; 0 when seen in the newest frame set."""
    hits: int
    confirmed: bool
    existence_probability: float = 1.0
    """Probability that it is a drone and still there; 1 in recordings from before it was estimated."""
    possible: tuple[PossibleMotion, ...] | None = None
    """The motions that it may have, the likeliest first; the position and velocity above are their mean. None: one, as
    above."""


@dataclass(frozen=True, eq=False)
class Wanted:
    """What the pilot asks for: the flock law's velocity, which is level, and the mission's height and heading.

    Only the gate turns it into what is allowed, a `Setpoint`.
    """

    velocity: Vector2
    """(2,) m/s, north and east: the law's after limits, and the trim."""
    acceleration: Vector2
    """(2,) m/s^2, north and east: u of Eq. 38 after limits; where a neighbour or an obstacle changed the velocity, the
    acceleration that leads to that in a step."""
    yaw_rad: float | None
    """Heading, clockwise from north, `wrapped`; None: as it is, while no good attitude is known."""
    trim: Vector2 | None = None
    """(2,) m/s, north and east: what of the velocity corrects the autopilot's own estimate; None: nothing."""
    height_m: float | None = None
    """As in `VehicleState`, up positive: the height that the mission wants; None: the one that the flight began at."""

    def __post_init__(self) -> None:
        if self.yaw_rad is not None:
            object.__setattr__(self, "yaw_rad", wrapped(self.yaw_rad))


@dataclass(frozen=True, eq=False)
class Setpoint:
    """What the gate allows: fly this horizontal velocity, hold this height, face this way. Nothing else makes one."""

    time_s: float
    """When it was decided."""
    velocity: Vector2
    """(2,) m/s, north and east."""
    height_m: float
    """As in `VehicleState`, up positive."""
    yaw_rad: float
    """Heading, clockwise from north, `wrapped`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "yaw_rad", wrapped(self.yaw_rad))


@dataclass(frozen=True)
class SizeStatus:
    """What the drone has learned in flight of how large its neighbours are."""

    weaves: bool
    """Whether it moves up and down now, to learn it."""
    size_m: float | None = None
    """From tip to tip, from which ranges follow; None: not known well enough."""
    sigma: float | None = None
    """Relative standard deviation of `size_m`."""


@dataclass(frozen=True)
class LearnedSize:
    """How large a pilot found the others to be, for the pilot of the flight that follows."""

    size_m: float
    """From tip to tip."""
    sigma: float
    """Relative standard deviation of `size_m`."""


@dataclass(frozen=True, eq=False)
class PilotOutput:
    """Everything one step of the pilot found and decided."""

    time_s: float
    ego_motion: EgoMotion | None
    velocity: Vector3 | None
    """(3,) m/s NED: the own velocity that the law used; None before there is one."""
    detections: tuple[Detection, ...]
    detection_tracks: tuple[int, ...]
    """The track that each detection went to."""
    neighbours: tuple[Neighbour, ...]
    command: Wanted
    reasons: tuple[Reason, ...] = ()
    """Why something is missing; recorded as their texts."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Estimates refused in this step, by the reason's text."""
    stages_ms: Mapping[str, float] = field(default_factory=dict)
    """Time each stage took, as measured by the caller's clock; empty without one."""
    mission: MissionStatus = NO_STATUS
    """As of the last good step."""
    noisy_cameras: tuple[str, ...] = ()
    """Cameras whose images were not used: noise, damage, a lens that shows too little, another motion than the
    drone's."""
    ground: GroundEstimate | None = None
    """From the range finder, or the barometer in its place; None: no range finder is wanted, or there is no scale."""
    obstacles: ObstacleRanges | None = None
    """The local map; None where obstacles are not looked for."""
    seen_m: Sectors | None = None
    """(n,) metres: that of the local map, always: how far cameras looked lately; None: of a simulation without any."""
    size: SizeStatus | None = None
    """None while nothing is learned of the neighbours' size."""
