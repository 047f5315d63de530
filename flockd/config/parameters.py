"""The typed configuration of one drone: every parameter, its unit, its default and its limits.

Strict: an unknown key, a wrong type or a number that is not finite is refused. The defaults are the paper's where it
gives one.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from flockd.messages import OwnVelocitySource, ScaleSource

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector3 = tuple[float, float, float]


class Section(BaseModel):
    """A part of the configuration."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class IntrinsicsConfig(Section):
    """A camera's projection, in pixels; pixel centres at +0.5."""

    model: Literal["pinhole", "wide_angle"] = "pinhole"
    fx: Positive
    fy: Positive
    cx: Positive
    cy: Positive
    distortion: tuple[float, ...] = ()
    """Pinhole: k1 k2 p1 p2 [k3] (OpenCV). Wide angle: k1 k2 k3 k4 of the equidistant model. Empty: none."""


class ExtrinsicsConfig(Section):
    """Where a camera sits: body FRD metres, and its turn from looking forward: yaw right, pitch up, roll clockwise."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0


class CameraConfig(Section):
    """One camera of the rig."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]+$")]
    size_px: tuple[Annotated[int, Field(ge=32, le=8192)], Annotated[int, Field(ge=32, le=8192)]]
    """Width, height."""
    intrinsics: IntrinsicsConfig
    extrinsics: ExtrinsicsConfig = ExtrinsicsConfig()


class RigConfig(Section):
    """All cameras of the drone."""

    cameras: Annotated[tuple[CameraConfig, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _names_are_unique(self) -> Self:
        names = [camera.name for camera in self.cameras]
        doubled = {name for name in names if names.count(name) > 1}
        if doubled:
            raise ValueError(f"two cameras share the name {sorted(doubled)[0]!r}; give each its own")
        return self


class PerceptionConfig(Section):
    """Which model fills which role. A name is a manifest in `models/`, or a path to one."""

    flow: str = "flow"
    """`dis` is OpenCV's DIS flow instead of a network."""
    depth: str = "neighbours"
    segmentation: str = "neighbours"
    distance: str = "distance"
    """Second stage: a drone's range from its picture alone. `none`: the depth map decides."""
    models_dir: str | None = None
    """Folder of the manifests; by default the one that comes with flockd."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
    scale: ScaleSource = "height"
    """The background's metric scale: `network` (pure RGB, as in the paper) or `height` (attitude and height above
    ground from the autopilot)."""


class GeometryParameters(Section):
    """Algorithm 1 and what feeds it."""

    initial_threshold_m: Positive = 0.01
    min_inlier_ratio: Annotated[float, Field(gt=0, lt=1)] = 0.2
    hypotheses: Annotated[int, Field(ge=1, le=100_000)] = 200
    """IT_MAX of Algorithm 1."""
    max_threshold_m: Positive = 2.0
    """Beyond this the motion counts as not estimated."""
    background_stride_px: Annotated[int, Field(ge=1, le=256)] = 12
    max_depth_m: Positive = 40.0
    """Background farther away says little of the translation and is left out."""
    max_acceleration_m_s2: Positive = 6.0
    """An ego-motion that would need more than this since the last one is refused, twice in a row at most."""
    refine: bool = True
    """Polish the ego-motion by its reprojection error after Algorithm 1."""


class TrackingParameters(Section):
    """Neighbours over time."""

    confirm_hits: Annotated[int, Field(ge=1)] = 2
    max_unseen_s: Positive = 2.0
    gate_sigma: Positive = 4.0
    """Association gate in standard deviations."""
    min_gate_m: Positive = 0.5
    acceleration_sigma_m_s2: Positive = 0.2
    """How hard a neighbour may manoeuvre between two frame sets."""
    size_memory: Annotated[int, Field(ge=0)] = 0
    """Number of sightings over which a neighbour's physical size is averaged; 0: off."""


class WeightParameters(Section):
    """The influence weight W of Eq. 39 and 40."""

    kind: Literal["uniform", "nearest"] = "uniform"
    nearest: Annotated[int, Field(ge=1)] = 3
    """With kind `nearest`: weight 1 on this many, 0 on the rest."""


class FlockingParameters(Section):
    """Eq. 38-42, with the paper's values."""

    cohesion: NonNegative = 0.1
    """C_f"""
    alignment: NonNegative = 0.1
    """C_av"""
    separation: NonNegative = 10.0
    """C_c"""
    velocity: NonNegative = 1.0
    """C_vf"""
    observation_distance_m: Positive = 20.0
    """D_c"""
    desired_distance_m: Positive = 3.5
    """D_d"""
    separation_distance_m: Positive = 1.5
    """D_II"""
    weight: WeightParameters = WeightParameters()
    own_weight: NonNegative = 1.0
    """W_i of Eq. 42"""
    max_speed_m_s: Positive = 3.0
    max_acceleration_m_s2: Positive = 2.0


class DesiredVelocityParameters(Section):
    """Eq. 43: a circle, then the tangent."""

    speed_m_s: NonNegative = 1.0
    radius_m: Positive = 10.0
    circle_until_s: NonNegative = 66.0


class AutopilotParameters(Section):
    """How flockd reaches this drone's autopilot, and what it may ask of it."""

    address: Annotated[str, Field(pattern=r"^(udpin|udpout|tcpin|tcpout|serial)://.+:\d+$")] = "udpin://127.0.0.1:14540"
    """`udpin://` waits for an autopilot that sends to this address; `serial:///dev/ttyS1:921600` is a cable."""
    system_id: Annotated[int, Field(ge=1, le=255)] | None = None
    """The autopilot's MAV_SYS_ID; others are ignored. By default the first that is heard."""
    setpoint_rate_hz: Annotated[float, Field(ge=5, le=50)] = 20.0
    max_setpoint_age_s: Positive = 1.0
    """An older setpoint is not sent."""
    max_control_age_s: Annotated[float, Field(gt=0, le=0.4)] = 0.3
    """Nothing is sent when the control loop has not been heard for this long."""
    max_gap_s: Annotated[float, Field(gt=0, le=0.9)] = 0.5
    """A longer gap between setpoints in offboard flight ends the stream until it is begun anew. Keep it below PX4's
    COM_OF_LOSS_T: PX4 returns to offboard by itself when setpoints come back."""
    max_heartbeat_age_s: Positive = 2.0
    """The link counts as lost when the autopilot has not been heard for this long."""
    on_failure: Literal["hold", "land"] = "hold"
    """What flockd asks of the autopilot when it has to give up."""
    arm_and_take_off: bool = False
    """By default the pilot arms, brings the drone up and switches to offboard."""
    height_m: Positive | None = None
    """Height above home to fly at; by default the height at which the flight begins."""


class RecordingConfig(Section):
    """How a flight is written down, where it is."""

    images: Literal["png", "jpeg"] = "png"
    """`png` loses nothing: only then does a replay equal the flight."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 90
    queue_mb: Positive = 64.0
    """What waits for the disk; beyond it steps are dropped."""
    file_mb: Positive = 2000.0
    """Then the recording goes on in a new file."""
    quota_mb: Positive = 20000.0
    """Of the drone's recordings in one folder together: the oldest are deleted to make room."""

    @model_validator(mode="after")
    def _a_file_fits(self) -> Self:
        if self.file_mb > self.quota_mb:
            raise ValueError(f"a file of {self.file_mb:g} MB does not fit into {self.quota_mb:g} MB; raise quota_mb")
        return self


class DroneConfig(Section):
    """Everything one drone's pilot needs."""

    step_s: Positive = 0.5
    rig: RigConfig
    perception: PerceptionConfig = PerceptionConfig()
    geometry: GeometryParameters = GeometryParameters()
    tracking: TrackingParameters = TrackingParameters()
    flocking: FlockingParameters = FlockingParameters()
    desired: DesiredVelocityParameters = DesiredVelocityParameters()
    own_velocity: OwnVelocitySource = "vision"
    yaw: Literal["hold", "course"] = "course"
    """Heading: kept as it is, or along the desired velocity."""
    recording: RecordingConfig = RecordingConfig()
    autopilot: AutopilotParameters | None = None
    """None: this drone's commands go nowhere but to the simulator."""
