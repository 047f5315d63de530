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


class MeasurementConfig(Section):
    """Where calibrated numbers come from: for people, nothing flies by it. `flockd calibrate` writes it."""

    date: Annotated[str, Field(pattern=r"^\d{4}-\d{2}-\d{2}$")]
    camera: str
    """Its serial number, or what else identifies it."""
    source: str
    """What it was measured from."""
    views: Annotated[int, Field(ge=1)]
    """Of a board, or pairs of images of what lay about."""
    residual_px: NonNegative | None = None
    """Root mean square of what the fit left over."""
    residual_deg: NonNegative | None = None
    """The same, of a fit to attitudes."""


class IntrinsicsConfig(Section):
    """A camera's projection, in pixels; pixel centres at +0.5."""

    model: Literal["pinhole", "wide_angle"] = "pinhole"
    fx: Positive
    fy: Positive
    cx: Positive
    cy: Positive
    distortion: tuple[float, ...] = ()
    """Pinhole: k1 k2 p1 p2 [k3] (OpenCV). Wide angle: k1 k2 k3 k4 of the equidistant model. Empty: none."""
    measured: MeasurementConfig | None = None


class ExtrinsicsConfig(Section):
    """Where a camera sits: body FRD metres, and its turn from looking forward: yaw right, pitch up, roll clockwise."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    measured: MeasurementConfig | None = None


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
    time_offset_s: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Added to the time stamp of a frame, the time at which the autopilot had the attitude it was taken in."""

    @model_validator(mode="after")
    def _names_are_unique(self) -> Self:
        names = [camera.name for camera in self.cameras]
        doubled = {name for name in names if names.count(name) > 1}
        if doubled:
            raise ValueError(f"two cameras share the name {sorted(doubled)[0]!r}; give each its own")
        return self


Provider = Literal["cpu", "cuda", "tensorrt", "openvino"]
"""What computes the networks: ONNX Runtime's execution providers."""


class PerceptionConfig(Section):
    """Which model fills which role. A name is a manifest in `models_dir`, or a path to one that ends in `.yaml`.

    Relative paths count from the folder of the configuration file.
    """

    flow: str = "flow_int8"
    """`dis` is OpenCV's DIS flow instead of a network."""
    flow_refinement: Literal["dis", "quick_dis", "none"] = "quick_dis"
    """A network's flow finds what moved far; DIS then makes it exact. `quick_dis` is for flight: 12 ms an image, where
    `dis` takes 34, and where the images show nothing, what is around tells the flow. With a sensor's depth, on images
    that are blurred and moved far, `dis` is worth its time, and every pixel keeps its own flow.
    """
    flow_refinement_scale: Annotated[int, Field(ge=0, le=5)] = 1
    """Where DIS after a network stops: at a 2^n-th of the size."""
    depth: str = "neighbours_int8"
    segmentation: str = "neighbours_int8"
    distance: str = "distance_int8"
    """Second stage: a drone's range from its picture alone. `none`: the depth map decides."""
    models_dir: str | None = None
    """Folder of the manifests; by default the one that comes with flockd."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
    provider: Provider = "cpu"
    """What ONNX Runtime computes with. Another one than this is never used in its place."""
    engines_dir: str | None = None
    """Where `flockd models prepare` keeps what a provider has built; by default `engines` beside the manifests."""
    deadline_s: Positive = 1.0
    """In flight, a network that has not answered one call by then is stuck, and is ended."""
    scale: ScaleSource = "height"
    """The background's metric scale: `network` (pure RGB, as in the paper), `height` (attitude and height above ground
    from the autopilot) or `velocity` (attitude and velocity from the autopilot; the drone has to move)."""


class GeometryParameters(Section):
    """Algorithm 1 and what feeds it."""

    initial_threshold_m: Positive = 0.01
    min_inlier_ratio: Annotated[float, Field(gt=0, lt=1)] = 0.2
    hypotheses: Annotated[int, Field(ge=1, le=100_000)] = 200
    """IT_MAX of Algorithm 1."""
    max_threshold_m: Positive = 2.0
    """Beyond this the motion counts as not estimated."""
    background_stride_px: Annotated[int, Field(ge=1, le=256)] = 16
    max_depth_m: Positive = 40.0
    """Background farther away says little of the translation and is left out."""
    max_acceleration_m_s2: Positive = 6.0
    """An ego-motion that would need more than this since the last one is refused, twice in a row at most."""
    refine: bool = True
    """Polish the ego-motion by its reprojection error after Algorithm 1."""


class TrackingParameters(Section):
    """Neighbours over time."""

    confirm_hits: Annotated[int, Field(ge=1)] = 3
    confirm_evidence: Annotated[float, Field(ge=0, lt=1)] = 0.85
    """A track is confirmed when the average of its last ten steps is above this: a sighting that is a drone with
    probability p counts 2 p - 1, a step without one 0."""
    keep_evidence: Annotated[float, Field(ge=0, lt=1)] = 0.6
    """It stays confirmed while that average is above this."""
    max_unseen_s: Positive = 1.5
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


class GateParameters(Section):
    """The last limits on what is sent to the autopilot, whatever asks for it."""

    permission_timeout_s: Annotated[float, Field(gt=0, le=0.4)] = 0.3
    """The supervisor's permission is good for this long: what has stalled sends nothing half a second later."""
    command_timeout_s: Positive = 1.5
    """A command older than this is not flown; leave the pilot three of its steps."""
    max_speed_m_s: Positive = 4.0
    """A command that asks for more is a fault, and refused."""
    max_acceleration_m_s2: Positive = 5.0
    degraded_speed_m_s: Positive = 1.0
    """Instead, while the drone is degraded: a command that asks for more is flown this fast."""
    min_separation_m: NonNegative = 1.0
    """Nearer than this to a neighbour, no velocity towards it."""
    degraded_separation_m: NonNegative = 1.5
    """Instead, while the drone is degraded."""
    fence_radius_m: Positive | None = 100.0
    """Around home, level; beyond it only inward velocity. null: no circle."""
    fence_corners_m: tuple[tuple[float, float], ...] = ()
    """A fence of any shape: its corners north and east of home, in order. With a radius too, both hold."""
    min_height_m: float = 1.0
    max_height_m: float = 30.0

    @model_validator(mode="after")
    def _limits_agree(self) -> Self:
        if self.min_height_m >= self.max_height_m:
            raise ValueError(f"min_height_m {self.min_height_m:g} is not below max_height_m; write a smaller one")
        if self.degraded_speed_m_s > self.max_speed_m_s:
            raise ValueError("degraded_speed_m_s is above max_speed_m_s; write a smaller one")
        if self.degraded_separation_m < self.min_separation_m:
            raise ValueError("degraded_separation_m is below min_separation_m; write a larger one")
        if 0 < len(self.fence_corners_m) < 3:
            raise ValueError("fence_corners_m has fewer than 3 corners; add the others, or delete it")
        if len(set(self.fence_corners_m)) < len(self.fence_corners_m):
            raise ValueError("fence_corners_m names a corner twice; delete one, the fence closes by itself")
        return self


AutopilotMode = Literal["hold", "return", "land"]


class SafetyParameters(Section):
    """When the drone slows down, hovers, hands over to the autopilot and falls silent."""

    gate: GateParameters = GateParameters()
    camera_timeout_periods: Positive = 3.0
    """A camera without a usable frame for this many of its frame periods is lost."""
    max_lost_cameras: Annotated[int, Field(ge=0)] = 1
    """Fly on with the rest, degraded, while no more than this many are lost; at least one has to see."""
    max_dropped_share: Share = 0.2
    """Of the frames of late; above it, degraded."""
    estimate_timeout_s: Positive = 1.5
    """Hover when the pilot's newest output is older than this; leave it three of its steps."""
    degraded_ego_motion_failures: Annotated[int, Field(ge=1)] = 2
    """Steps in a row without own motion, to be degraded."""
    max_ego_motion_failures: Annotated[int, Field(ge=1)] = 6
    """Steps in a row without own motion, to hover."""
    degraded_load: Positive = 1.0
    """How long the steps take (95th percentile) over how long they may, to be degraded."""
    max_load: Positive = 2.0
    """The same, to hover."""
    degraded_temperature_c: float = 85.0
    """Of the hottest thermal zone, to be degraded."""
    max_temperature_c: float = 95.0
    """The same, to hover."""
    max_loop_lag_s: Positive = 0.2
    """Of the event loop; above it, degraded."""
    heartbeat_timeout_s: Positive = 2.0
    """The link to the autopilot counts as lost, and flockd falls silent for good."""
    neighbours_timeout_s: Positive = 2.0
    """No confirmed neighbour seen for this long: the drone is alone."""
    alone_s: Positive | None = 10.0
    """How long it flies on alone before it asks for Hold. null: for ever."""
    outside_s: Positive = 3.0
    """How long it may take to come back into the fence and the heights before it asks for Hold."""
    on_battery_low: AutopilotMode = "hold"
    """What is asked of the autopilot when it says that its battery is low."""
    on_position_lost: AutopilotMode = "hold"
    """What is asked of the autopilot when it has lost its position; it acts by itself too."""
    hover_s: Annotated[float, Field(gt=0, le=3)] = 1.0
    """The longest hover, before Hold is asked for."""
    recovery_s: NonNegative = 2.0
    """How long all has to be well before a degraded drone flies as usual again."""
    ask_timeout_s: Annotated[float, Field(gt=0, le=5)] = 2.0
    """How long the autopilot has to leave offboard when asked, before silence makes it."""

    @model_validator(mode="after")
    def _worse_comes_later(self) -> Self:
        for mild, grave in (
            ("degraded_ego_motion_failures", "max_ego_motion_failures"),
            ("degraded_load", "max_load"),
            ("degraded_temperature_c", "max_temperature_c"),
        ):
            if getattr(self, mild) > getattr(self, grave):
                raise ValueError(f"{mild} is above {grave}; write a smaller one")
        return self


class DesiredVelocityParameters(Section):
    """Eq. 43: a circle, then the tangent."""

    speed_m_s: NonNegative = 1.0
    radius_m: Positive = 10.0
    circle_until_s: NonNegative = 66.0


class ControlParameters(Section):
    """One setting of a camera's driver."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
    """As `v4l2-ctl --list-ctrls` prints it."""
    value: int
    """A menu's entry by its number; a switch as 0 or 1."""


class CameraDeviceParameters(Section):
    """Where one camera of the rig is plugged in, and how it is run. Its image has the size the rig says."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]+$")]
    """The camera's name in the rig."""
    device: Annotated[str, Field(pattern=r"^/dev/")]
    pixel_format: Literal["mjpeg", "yuyv"] = "mjpeg"
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 30.0
    controls: tuple[ControlParameters, ...] = ()
    """Set in this order whenever the camera is opened; what is not named here stays as it was."""


class SharedMemoryParameters(Section):
    """Where frames come from when another program on this computer takes or draws them."""

    drone: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")] = "drone"
    """Whose frames: the name under which they are published."""
    connect: Annotated[tuple[str, ...], Field(min_length=1)] = ("tcp/127.0.0.1:7448",)
    """zenoh endpoints of the program that publishes them."""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """How often each camera's frames come; `safety.camera_timeout_periods` counts in these."""
    speed_factor: Annotated[float, Field(ge=0.1, le=10)] = 1.0
    """How fast a simulator's time passes: at 0.5, half a second of it in each real one, and all of flockd's times and
    time-outs count in it."""


class SourceParameters(Section):
    """Where camera frames come from, and how those of several cameras become sets."""

    kind: Literal["v4l2", "shared_memory"]
    cameras: tuple[CameraDeviceParameters, ...] = ()
    """Of kind `v4l2`: one for each camera of the rig."""
    shared_memory: SharedMemoryParameters = SharedMemoryParameters()
    """Of kind `shared_memory`."""
    set_tolerance_s: Positive = 0.02
    """How far the time stamp of a frame may be from that of its set; half a frame period or more."""
    set_wait_s: Positive = 0.1
    """How long a set waits for a camera that is late, or gone."""
    silence_s: Positive = 0.5
    """A camera without a usable frame for this long is closed and opened again."""
    frozen_after: Annotated[int, Field(ge=0)] = 5
    """A picture that repeats itself this many times is frozen, and counts as no picture; 0: may repeat for ever."""

    @model_validator(mode="after")
    def _fits_its_kind(self) -> Self:
        if self.kind == "shared_memory" and self.cameras:
            raise ValueError("a source of kind `shared_memory` has no devices; delete `cameras`")
        if self.kind == "v4l2" and self.shared_memory.speed_factor != 1.0:
            raise ValueError("real cameras know real time only; delete `shared_memory.speed_factor`")
        for camera in self.cameras:
            if self.set_tolerance_s * camera.rate_hz < 0.5:
                raise ValueError(
                    f"set_tolerance_s {self.set_tolerance_s:g} is less than half a frame period of camera "
                    f"{camera.name!r}; write {0.5 / camera.rate_hz:.3f} or more"
                )
            if self.silence_s * camera.rate_hz < 2.0:
                raise ValueError(
                    f"silence_s {self.silence_s:g} is less than two frame periods of camera {camera.name!r}; "
                    f"write {2.0 / camera.rate_hz:.3f} or more"
                )
        devices = [camera.device for camera in self.cameras]
        doubled = {device for device in devices if devices.count(device) > 1}
        if doubled:
            raise ValueError(f"two cameras share {sorted(doubled)[0]}; give each its own device")
        return self


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
    max_velocity_trim_m_s: NonNegative = 0.5
    """Where the autopilot's velocity and the cameras' differ, setpoints are corrected by up to this: an autopilot flies
    by its own estimate, which GNSS alone leaves off by 0.1 to 0.3 m/s. 0: not at all. Does nothing with `own_velocity:
    autopilot`."""
    low_battery_share: Share = 0.2
    """The battery counts as low when the autopilot says that no more than this is left."""


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


OperatorCommand = Literal["hold", "land", "resume"]


class TelemetryParameters(Section):
    """Who may watch this drone, and what they may ask of it."""

    fleet: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")] = "fleet"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """zenoh endpoints at which watchers find this drone, as in `tcp/0.0.0.0:7447`."""
    connect: tuple[str, ...] = ()
    """zenoh endpoints, of a router or of `flockd status --listen`, that this drone tries to reach for ever."""
    zenoh_config: str | None = None
    """A file of zenoh's own settings to begin with, for TLS and access control; see `config/zenoh_tls.json5`. A
    relative path counts from the folder of the configuration file."""
    commands: tuple[OperatorCommand, ...] = ()
    """What operators may ask over telemetry; by default nothing."""


class DroneConfig(Section):
    """Everything one drone's pilot needs."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")] = "drone"
    """By which it is known in telemetry and recordings; different for each drone of a fleet."""
    step_s: Positive = 0.5
    rig: RigConfig
    source: SourceParameters | None = None
    """Where the frames come from; needed to fly, not to simulate."""
    perception: PerceptionConfig = PerceptionConfig()
    geometry: GeometryParameters = GeometryParameters()
    tracking: TrackingParameters = TrackingParameters()
    flocking: FlockingParameters = FlockingParameters()
    desired: DesiredVelocityParameters = DesiredVelocityParameters()
    safety: SafetyParameters = SafetyParameters()
    own_velocity: OwnVelocitySource = "vision"
    yaw: Literal["hold", "course"] = "course"
    """Heading: kept as it is, or along the desired velocity."""

    @model_validator(mode="after")
    def _the_gate_lets_the_law_through(self) -> Self:
        if self.flocking.max_speed_m_s > self.safety.gate.max_speed_m_s:
            raise ValueError(
                f"flocking.max_speed_m_s {self.flocking.max_speed_m_s:g} is above safety.gate.max_speed_m_s, which "
                f"would refuse it; write {self.safety.gate.max_speed_m_s:g} or less"
            )
        return self

    recording: RecordingConfig = RecordingConfig()
    autopilot: AutopilotParameters | None = None
    """None: this drone's commands go nowhere but to the simulator."""
    telemetry: TelemetryParameters = TelemetryParameters()

    @property
    def speed_factor(self) -> float:
        """How fast this drone's time passes: 1 unless it is simulated."""
        return 1.0 if self.source is None else self.source.shared_memory.speed_factor

    @model_validator(mode="after")
    def _the_gate_lets_the_trim_through(self) -> Self:
        gate_m_s, law_m_s = self.safety.gate.max_speed_m_s, self.flocking.max_speed_m_s
        trim_m_s = 0.0 if self.autopilot is None else self.autopilot.max_velocity_trim_m_s
        if law_m_s + trim_m_s > gate_m_s:
            raise ValueError(
                f"flocking.max_speed_m_s {law_m_s:g} and autopilot.max_velocity_trim_m_s {trim_m_s:g} are above "
                f"safety.gate.max_speed_m_s, which would refuse them; write {gate_m_s - law_m_s:g} or less for the trim"
            )
        return self

    @model_validator(mode="after")
    def _only_simulated_time_is_slow(self) -> Self:
        if self.speed_factor != 1.0 and self.autopilot is not None and self.autopilot.address.startswith("serial:"):
            raise ValueError(
                "source.shared_memory.speed_factor is for simulations, and an autopilot on a cable is none; delete it"
            )
        return self

    @model_validator(mode="after")
    def _every_camera_has_its_device(self) -> Self:
        if self.source is None or self.source.kind != "v4l2":
            return self
        rig = [camera.name for camera in self.rig.cameras]
        devices = [camera.name for camera in self.source.cameras]
        if sorted(rig) != sorted(devices):
            raise ValueError(
                f"source.cameras names {', '.join(devices) or 'none'}, but the rig has {', '.join(rig)}; "
                "give each camera of the rig one entry of the same name"
            )
        return self
