"""The source of camera frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from flockd.core import services
from flockd.core.choices import PixelFormat
from flockd.core.config.base import Endpoint, Name, PlainName, Section, refuse, text
from flockd.core.secrets import masked

Topic = Annotated[str, text(r"^(/[A-Za-z_][A-Za-z0-9_]*)+$", "a whole name of ROS 2, as in `/front/image_raw`")]


def _linkable(pipeline: str) -> str:
    """Raises ValueError for what is no pipeline to which a sink can be added."""
    elements = [element.split() for element in pipeline.split("!")]
    if not all(elements):
        raise ValueError("has an element without a name; write one on both sides of each `!`")
    if elements[0][0].startswith("gst-launch"):
        raise ValueError(f"begins with {elements[0][0]}; write only what follows it")
    if elements[-1][0].endswith("sink"):
        raise ValueError(f"ends with {elements[-1][0]}, and flockd adds its own sink; delete it")
    return pipeline


class ControlParameters(Section):
    """One setting of a camera's driver."""

    name: Annotated[str, text(r"^[a-z0-9_]+$", "a control's name, of small letters, digits and `_`")]
    """As `v4l2-ctl --list-ctrls` prints it."""
    value: int
    """For a menu the number of the entry; for a switch 0 or 1."""


_Edge = Annotated[int, Field(ge=0, le=32768)]
_Side = Annotated[int, Field(ge=32, le=32768)]


class CameraDeviceParameters(Section):
    """The device of one camera of the rig, and its settings. Its image must have the rig's `size_px`."""

    name: PlainName
    """The camera's name in the rig."""
    device: (
        Annotated[str, text(r"^/dev/", "a device, as in `/dev/video0` or an entry of `/dev/v4l/by-path`")] | None
    ) = None
    """For kind `v4l2`: the path of the device, preferably one in /dev/v4l/by-path."""
    pipeline: Annotated[str, AfterValidator(_linkable)] | None = None
    """For kind `gstreamer`: a pipeline as for `gst-launch-1.0`, without a sink."""
    topic: Topic | None = None
    """For kind `ros`: a topic of sensor_msgs/Image or CompressedImage, such as `/front/image_raw`."""
    camera_info: Topic | None = None
    """For kind `ros`: topic of its CameraInfo, which must agree with the rig; by default `camera_info` beside the
    images."""
    stamps: Literal["system", "simulator"] = "system"
    """For kind `ros`: the clock of the images' stamps, either this computer's or a simulator's on `/clock`. The
    simulator has to run in real time."""
    pixel_format: PixelFormat = "mjpeg"
    """For kind `v4l2`; pipelines and topics give it themselves."""
    turn_deg: Literal[0, 90, 180, 270] = 0
    """For kind `v4l2`: clockwise angle that turns images upright if the camera is mounted on its side or upside down.
    `size_px` and the lens in the rig are those of the turned image. In pipelines use `videoflip`. Parts that `crop`
    cuts are turned for every kind."""
    crop: tuple[_Edge, _Edge, _Side, _Side] | None = None
    """Left, top, width and height of this camera's part, in pixels of the image as it comes. For boards that send one
    image of several cameras: their entries name the same device, pipeline or topic, each with its crop. `size_px` and
    the lens in the rig are those of the part."""
    crop_of: tuple[_Side, _Side] | None = None
    """Width and height of the whole image that `crop` is a part of; by default it ends where the crops end."""
    reduce: Literal[1, 2, 4] = 1
    """For kind `v4l2`: the camera sends images that are wider and higher than `size_px` by this factor, and flockd
    reduces them. This lowers noise and compression artefacts."""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 30.0
    controls: tuple[ControlParameters, ...] = ()
    """For kind `v4l2`: settings of the driver, in this order, each time the camera is opened; others stay unchanged."""

    @property
    def place(self) -> str:
        """The device, the pipeline or the topic."""
        return self.device or self.pipeline or self.topic or ""

    @property
    def size_words(self) -> tuple[str, str]:
        """For errors: the words for the place that sets the size of the device's images, and the key."""
        return ("the rig has", "size_px") if self.crop is None else ("its crop is of", "crop_of")

    @property
    def cut_px(self) -> tuple[int, int] | None:
        """Width and height of `crop`, reduced and turned; `size_px` in the rig must equal it."""
        if self.crop is None:
            return None
        width, height = (side // self.reduce for side in self.crop[2:])
        return (width, height) if self.turn_deg % 180 == 0 else (height, width)


class SharedMemoryParameters(Section):
    """Frames that another program on this computer publishes."""

    drone: Name = "drone"
    """The drone's name under which the frames are published."""
    connect: Annotated[tuple[Endpoint, ...], Field(min_length=1)] = ("tcp/127.0.0.1:7448",)
    """zenoh endpoints of the program that publishes them."""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """Rate of each camera's frames; its period is the unit of `safety.camera_timeout_periods`."""
    speed_factor: Annotated[float, Field(ge=0.02, le=10)] = 1.0
    """Speed of a simulator's time: at 0.5, half a simulated second passes in a real second. All times and time-outs of
    flockd are in simulated time."""


class SourceParameters(Section):
    """The source of camera frames, and how frames of several cameras are combined into sets."""

    kind: Literal["v4l2", "gstreamer", "ros", "shared_memory"]
    """V4L2 devices, GStreamer pipelines, topics of ROS 2, or frames of another program."""
    cameras: tuple[CameraDeviceParameters, ...] = ()
    """One entry for each camera of the rig, for all kinds but `shared_memory`."""
    shared_memory: SharedMemoryParameters = SharedMemoryParameters()
    """For kind `shared_memory`."""
    set_tolerance_s: Annotated[float, Field(gt=0, le=60)] = 0.02
    """Largest difference of time stamps between a frame and its set; at least half a frame period."""
    set_wait_s: Annotated[float, Field(gt=0, le=60)] = 0.1
    """Time for which a set waits for a late or lost camera."""
    silence_s: Annotated[float, Field(gt=0, le=60)] = services.FRAME_SILENCE.timeout
    """A camera without a usable frame for this long is closed and opened again."""
    frozen_after: Annotated[int, Field(ge=0)] = 5
    """After this many repetitions of one image the camera counts as frozen; 0: no limit."""

    @model_validator(mode="after")
    def _fits_its_kind(self) -> Self:
        if self.kind == "shared_memory" and self.cameras:
            raise ValueError("a source of kind `shared_memory` has no devices; delete `cameras`")
        if self.kind != "shared_memory" and self.shared_memory.speed_factor != 1.0:
            raise ValueError("real cameras need real time; delete `shared_memory.speed_factor`")
        for number, camera in enumerate(self.cameras):
            refuse(self, {("cameras", number, *key): text for key, text in _misplaced(camera, self.kind).items()})
            for key, periods, words in (
                ("set_tolerance_s", 0.5, "half a frame period"),
                ("silence_s", 2.0, "two frame periods"),
            ):
                if getattr(self, key) * camera.rate_hz < periods:
                    told = (
                        f"is less than {words} of camera {camera.name!r}; write {periods / camera.rate_hz:.3f} or more"
                    )
                    refuse(self, {(key,): f"{getattr(self, key):g} {told}"})
        for number, camera in enumerate(self.cameras):
            first = next(one for one in self.cameras if one.place == camera.place)
            faults = _crop_faults(camera, self.whole_px(camera)) if camera.crop else {}
            if camera is not first:
                faults |= _sharing_faults(camera, self.cameras[:number], _KEYS[self.kind][0])
            refuse(self, {("cameras", number, key): text for key, text in faults.items()})
        return self

    def whole_px(self, camera: CameraDeviceParameters) -> tuple[int, int]:
        """Width and height of the whole image that a camera's `crop` is a part of."""
        crops = [one.crop for one in self.cameras if one.place == camera.place and one.crop is not None]
        right, lower = (max(crop[axis] + crop[axis + 2] for crop in crops) for axis in (0, 1))
        return camera.crop_of or (right, lower)


def _crop_faults(camera: CameraDeviceParameters, whole: tuple[int, int]) -> dict[str, str]:
    assert camera.crop is not None
    left, top, width, height = camera.crop
    faults = {}
    if left + width > whole[0] or top + height > whole[1]:
        faults["crop"] = (
            f"{list(camera.crop)} ends outside {whole[0]} x {whole[1]} of the image; correct it, or crop_of"
        )
    elif any(length % camera.reduce for length in (*camera.crop, *whole)):
        faults["crop"] = f"{list(camera.crop)} and its image are no multiples of reduce {camera.reduce}; correct one"
    if camera.camera_info is not None:
        faults["camera_info"] = "is of a whole image, and this camera has a crop of it; delete it"
    return faults


def _sharing_faults(
    camera: CameraDeviceParameters, others: Sequence[CameraDeviceParameters], key: str
) -> dict[str, str]:
    """Faults of a camera that shares its device, pipeline or topic with others."""
    mates = [one for one in others if one.place == camera.place]
    first = mates[0]
    if camera.crop is None or first.crop is None:
        told = f"two cameras share {masked(camera.place)}; give each its own {key}, or each its `crop` of one image"
        return {key: told}
    faults = {
        field: f"differs from that of camera {first.name}, which is cut from the same image; write both alike"
        for field in ("crop_of", "pixel_format", "reduce", "rate_hz", "stamps", "controls")
        if getattr(camera, field) != getattr(first, field)
    }
    for mate in mates:
        if mate.crop and all(
            camera.crop[axis] < mate.crop[axis] + mate.crop[axis + 2]
            and mate.crop[axis] < camera.crop[axis] + camera.crop[axis + 2]
            for axis in (0, 1)
        ):
            faults["crop"] = f"{list(camera.crop)} overlaps that of camera {mate.name}; cut each from a part of its own"
    return faults


_KEYS = {
    "v4l2": ("device", "pixel_format", "controls", "turn_deg", "reduce"),
    "gstreamer": ("pipeline",),
    "ros": ("topic", "camera_info", "stamps"),
}
"""Keys of a camera that only one kind of source has; the first one names the camera's place."""
_LACKS = {
    "v4l2": "has no `device`; write the camera's path, as `flockd cameras` lists it",
    "gstreamer": "has no `pipeline`; write elements such as `v4l2src device=/dev/video0`",
    "ros": "has no `topic`; write that of its images, as `ros2 topic list` shows it",
}


def _misplaced(camera: CameraDeviceParameters, kind: str) -> dict[tuple[str | int, ...], str]:
    """Faults of a camera's keys for this kind of source: keys that it must not have, by key, or a missing one."""
    faults: dict[tuple[str | int, ...], str] = {
        (key,): f"is of a source of kind `{other}`; delete it, or write `kind: {other}`"
        for other, keys in _KEYS.items()
        for key in keys
        if other != kind and getattr(camera, key) != type(camera).model_fields[key].default
        if not (camera.crop and key == "turn_deg")
    }
    controls = [control.name for control in camera.controls]
    faults |= {
        ("controls", number, "name"): f"{name} is set twice; delete one"
        for number, name in enumerate(controls)
        if name in controls[:number]
    }
    if camera.crop_of is not None and camera.crop is None:
        faults["crop_of",] = "is of a `crop`, and there is none; add it, or delete this"
    if not faults and kind in _KEYS and not getattr(camera, _KEYS[kind][0]):
        faults[()] = _LACKS[kind]
    return faults
