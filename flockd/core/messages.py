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
    """The part of a step that is missing."""

    INPUT = "input"
    """The whole step: frames or vehicle state are impossible."""
    HEIGHT = "height"
    """The configured source of the height."""
    CAMERA = "camera"
    """A camera's image, or a part of its perception."""
    LENS = "lens"
    """A camera's image, because its lens is covered or dirty."""
    PAIR = "pair"
    """The pair of frame sets."""
    PROPOSAL = "proposal"
    """A proposal."""
    EGO_MOTION = "ego_motion"
    NEIGHBOUR = "neighbour"
    """A neighbour, or its motion."""
    RIG = "rig"
    """A camera's image, because it does not move as the drone does."""
    RECORDED = "recorded"
    """Not known: recordings only have the text."""


@dataclass(frozen=True)
class Reason:
    """Why a step lacks something."""

    kind: ReasonKind
    text: str
    """One short sentence, the same for each occurrence; for people."""

    def __str__(self) -> str:
        return self.text


UNCLASSED = 255
"""Label of pixels that are not used: near a drone's outline, or on a drone that is not detected. The label of the
background is 0; each drone has its own value above 0."""


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
    """A reading of a range finder that faces down."""

    time_s: float
    """Time of the measurement, on the clock of `VehicleState`."""
    range_m: float
    """Along the body's down axis."""
    min_m: float | None = None
    """Shortest range of the sensor; None: not known."""
    max_m: float | None = None
    """Longest range of the sensor; None: not known."""
    quality: float | None = None
    """Signal quality from 0 (no signal) to 1; None: the sensor does not report it."""


@dataclass(frozen=True, eq=False)
class VehicleState:
    """The state by the drone's own autopilot. It contains no data of other drones."""

    time_s: float
    R_ned_body: Matrix3
    """(3, 3) attitude."""
    height_m: float
    """Height above home from the barometer, metres, up positive; on level ground the height above ground."""
    velocity_ned: Vector3 | None = None
    """(3,) m/s NED, the autopilot's estimate; None: it has none."""
    position: Vector2 | None = None
    """(2,) metres north and east of home, the autopilot's estimate; None: it has none."""
    home_deg: Vector2 | None = None
    """(2,) latitude and longitude of home; None: the autopilot does not know it."""
    ground_range: RangeReading | None = None
    """The newest reading of the range finder that faces down, whatever its age and quality; None: no reading yet."""
    turn_rate: Vector3 | None = None
    """(3,) rad/s about the body axes; None: not known."""


@dataclass(frozen=True, eq=False)
class GroundEstimate:
    """The ground below the drone as a plane, from which the metric scale of depth follows."""

    height_m: float
    """Height of the body's origin above the ground straight below."""
    slope: Vector2
    """(2,) rise of the ground for each metre to the north and to the east."""
    source: str
    """`range_finder` or `barometer`."""


@dataclass(frozen=True, eq=False)
class MissionOrder:
    """An operator's order to one drone's mission: a goal, in metres or in degrees, or a velocity."""

    place: Vector2 | None = None
    """(2,) metres north and east of the mission's origin."""
    place_deg: Vector2 | None = None
    """(2,) latitude and longitude."""
    velocity: Vector2 | None = None
    """(2,) m/s, north and east."""
    height_m: float | None = None
    """Height above the ground at home; None: unchanged."""
    speed_m_s: float | None = None
    """Speed on the way to the goal; None: the mission's."""


@dataclass(frozen=True, eq=False)
class MissionStatus:
    """Progress of a drone's mission."""

    kind: str
    desired: Vector2
    """(2,) m/s: W_i efv of Eq. 42, without `flocking.own_weight`."""
    sentence: str
    """What the drone does now, for people."""
    goal: Vector2 | None = None
    """(2,) metres north and east of home: its goal; None: it has no goal."""
    goal_height_m: float | None = None
    arrived: bool = False
    """At the last goal."""
    takeover: str | None = None
    """Mode to request from the autopilot at the end of the mission, `land` or `return`; None: no request."""

    @property
    def known(self) -> bool:
        """Whether a mission has reported this status."""
        return self.kind != NO_STATUS.kind


NO_STATUS = MissionStatus("unknown", np.zeros(2), "has not begun")
"""The status before a pilot's first valid step."""


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
    """Threshold at which Algorithm 1 found its inliers."""

    @property
    def velocity(self) -> FloatArray:
        """(3,) m/s in C, the mean over the interval (Eq. 21)."""
        return self.translation / self.interval_s


@dataclass(frozen=True, eq=False)
class Detection:
    """One drone detected in one frame set, before tracking, in log-polar coordinates: a bearing and a log range.

    In these coordinates a camera's errors are independent: an angle of the direction, and a share of the range.
    """

    bearing: Vector3
    """(3,) unit vector towards the drone's centre, body FRD of the frame set."""
    log_range: float
    """Natural logarithm of the range in metres."""
    covariance: Matrix3
    """(3, 3) in body axes, for the residual of `flockd.flight.geometry.log_polar_residual`: along the bearing the
    variance of the log range at a known size, across it that of the angle, rad^2."""
    drone_probability: float
    """Probability that it is a drone."""
    size_m: float
    """Estimated size of the drone, tip to tip, m: its range times its angular size."""
    cameras: tuple[str, ...]
    """Cameras that show it; more than one at the border of two images."""
    label: int
    """Its label in the masks of this frame set, from 1 up."""
    log_size_sigma: float = 0.0
    """Standard deviation of the logarithm of `size_m`. All log ranges of a drone have the same error."""

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
        """The same without the error of the size, which cancels in the distance flown between two detections."""
        return self.range_m * math.sqrt(float(self.bearing @ self.covariance @ self.bearing))


SECTORS = 72
"""Directions of `ObstacleRanges`: one every 5 degrees."""

Sectors = Annotated[FloatArray, Shape((SECTORS,))]


@dataclass(frozen=True, eq=False)
class ObstacleRanges:
    """Nearest obstacle in each of n equal horizontal sectors around the drone, within its band of heights.

    Sector k is centred on the azimuth 2 pi k / n, clockwise from north.
    """

    time_s: float
    range_m: Sectors
    """(n,) metres, horizontal, from the drone's centre; inf: no obstacle within `seen_m`."""
    sigma_m: Sectors
    """(n,) metres: standard deviation of `range_m`; 0 if that is inf."""
    seen_m: Sectors
    """(n,) metres: range up to which the sector is known to be free or measured; 0: not observed."""


@dataclass(frozen=True, eq=False)
class PossibleMotion:
    """A possible motion of a neighbour."""

    probability: float
    """Probability that it is the true one; those of a neighbour add up to 1."""
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
    """Time since it was last detected; 0: in the newest frame set."""
    hits: int
    confirmed: bool
    existence_probability: float = 1.0
    """Probability that it is a drone and still there; 1 in recordings of versions that did not estimate it."""
    possible: tuple[PossibleMotion, ...] | None = None
    """Its possible motions, the likeliest first; the position and velocity above are their mean. None: only the motion
    above."""


@dataclass(frozen=True, eq=False)
class Wanted:
    """The velocity, height and heading that the pilot wants, by flocking law and mission.

    Only the gate converts it to a `Setpoint`.
    """

    velocity: Vector2
    """(2,) m/s, north and east: the law's velocity after limits, plus `trim`."""
    acceleration: Vector2
    """(2,) m/s^2, north and east: u of Eq. 38 after limits. If passing or avoidance changed the velocity, the
    acceleration that reaches it in a step."""
    yaw_rad: float | None
    """Heading, clockwise from north, `wrapped`; None: unchanged, because no valid attitude is known."""
    trim: Vector2 | None = None
    """(2,) m/s, north and east: the part of `velocity` that corrects the autopilot's estimate; None: zero."""
    height_m: float | None = None
    """Height of the mission, as in `VehicleState`, up positive; None: the height at which the flight began."""

    def __post_init__(self) -> None:
        if self.yaw_rad is not None:
            object.__setattr__(self, "yaw_rad", wrapped(self.yaw_rad))


@dataclass(frozen=True, eq=False)
class Setpoint:
    """The permitted horizontal velocity, height and heading. Only the gate makes setpoints."""

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
    """The size of the neighbours that the drone has learned in flight."""

    weaves: bool
    """Whether the drone weaves up and down now to learn it."""
    size_m: float | None = None
    """Size from tip to tip that ranges use; None: not known well enough."""
    sigma: float | None = None
    """Relative standard deviation of `size_m`."""


@dataclass(frozen=True)
class LearnedSize:
    """The size of the others: configured, or learned by a pilot, also for the pilot of the next flight."""

    size_m: float
    """From tip to tip."""
    sigma: float
    """Relative standard deviation of `size_m`."""


@dataclass(frozen=True, eq=False)
class PilotOutput:
    """All results of one step of the pilot."""

    time_s: float
    ego_motion: EgoMotion | None
    velocity: Vector3 | None
    """(3,) m/s NED: the own velocity that the law used; None: not known yet."""
    detections: tuple[Detection, ...]
    detection_tracks: tuple[int, ...]
    """Track number of each detection."""
    neighbours: tuple[Neighbour, ...]
    command: Wanted
    reasons: tuple[Reason, ...] = ()
    """Reasons for missing parts; recordings contain their texts."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Estimates refused in this step, by the reason's text."""
    stages_ms: Mapping[str, float] = field(default_factory=dict)
    """Duration of each stage by the caller's stopwatch; empty without one."""
    mission: MissionStatus = NO_STATUS
    """As of the last valid step."""
    noisy_cameras: tuple[str, ...] = ()
    """Cameras whose images were not used: noise, damage, a covered lens, or a motion that differs from the drone's."""
    ground: GroundEstimate | None = None
    """From the range finder, or the barometer in its place; None: no range finder is configured, or no scale is
    known."""
    obstacles: ObstacleRanges | None = None
    """The local map; None: obstacles are not detected."""
    seen_m: Sectors | None = None
    """(n,) metres: the local map's `seen_m`, even without obstacle detection; None: a simulation without cameras."""
    size: SizeStatus | None = None
    """None: no size is learned."""
