"""Where camera frames come from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from flockd.core import services
from flockd.core.choices import PixelFormat
from flockd.core.config.base import Endpoint, Name, PlainName, Section, refuse, text
from flockd.core.secrets import masked

_TOPIC = r"^(/[A-Za-z_][A-Za-z0-9_]*)+$"
"""A whole name of ROS 2."""


class ControlParameters(Section):
    """One setting of a camera's driver."""

    name: Annotated[str, text(r"^[a-z0-9_]+$", "a control's name, of small letters, digits and `_`")]
    """As `v4l2-ctl --list-ctrls` prints it."""
    value: int
    """A menu's entry by its number; a switch as 0 or 1."""


_Edge = Annotated[int, Field(ge=0, le=32768)]
_Side = Annotated[int, Field(ge=32, le=32768)]


class CameraDeviceParameters(Section):
    """Where one camera of the rig is plugged in, and how it is run. Its image has the size the rig says."""

    name: PlainName
    """The camera's name in the rig."""
    device: (
        Annotated[str, text(r"^/dev/", "a device, as in `/dev/video0` or an entry of `/dev/v4l/by-path`")] | None
    ) = None
    """For kind `v4l2`: its path, best one of /dev/v4l/by-path."""
    pipeline: Annotated[str, Field(min_length=1)] | None = None
    """For kind `gstreamer`: elements as `gst-launch-1.0` takes them, without a sink."""
    topic: Annotated[str, Field(pattern=_TOPIC)] | None = None
    """For kind `ros`: of sensor_msgs/Image or CompressedImage, as in `/front/image_raw`."""
    camera_info: Annotated[str, Field(pattern=_TOPIC)] | None = None
    """For kind `ros`: of its CameraInfo, which is compared with the rig; by default `camera_info` beside the images."""
    stamps: Literal["system", "simulator"] = "system"
    """For kind `ros`: what the images' stamps are of, this computer's clock or that of a simulator in `/clock`, which
    has to run in real time."""
    pixel_format: PixelFormat = "mjpeg"
    """For kind `v4l2`; pipelines and topics say it themselves."""
    turn_deg: Literal[0, 90, 180, 270] = 0
    """For kind `v4l2`: by how much its images are turned, clockwise, so that up is up, where the camera is mounted on
    its side or upside down. `size_px` and the lens in the rig are of the turned image. Pipelines have `videoflip`; the
    parts that `crop` cuts are turned for each kind."""
    crop: tuple[_Edge, _Edge, _Side, _Side] | None = None
    """Left, top, width and height of this camera's part, in pixels of the image as it comes. Boards for several cameras
    send one image of all: their entries name one device, pipeline or topic, each with its crop. `size_px` and the lens
    in the rig are of the part."""
    crop_of: tuple[_Side, _Side] | None = None
    """Width and height of the image that `crop` is cut from; by default it ends where the crops end."""
    reduce: Literal[1, 2, 4] = 1
    """For kind `v4l2`: the camera sends images this many times as wide and as high as the rig says, and flockd reduces
    them: they then have less noise and less of what compression leaves."""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 30.0
    controls: tuple[ControlParameters, ...] = ()
    """For kind `v4l2`: set in this order whenever the camera is opened; what is not named here stays as it was."""

    @property
    def place(self) -> str:
        """Where its images come from: the device, the pipeline or the topic."""
        return self.device or self.pipeline or self.topic or ""

    @property
    def size_words(self) -> tuple[str, str]:
        """What says how large its device's images are, and the key that says it."""
        return ("the rig has", "size_px") if self.crop is None else ("its crop is of", "crop_of")

    @property
    def cut_px(self) -> tuple[int, int] | None:
        """Width and height of `crop`, reduced and turned: what `size_px` in the rig has to be."""
        if self.crop is None:
            return None
        width, height = (side // self.reduce for side in self.crop[2:])
        return (width, height) if self.turn_deg % 180 == 0 else (height, width)


class SharedMemoryParameters(Section):
    """Where frames come from when another program on this computer takes or draws them."""

    drone: Name = "drone"
    """Whose frames: the name under which they are published."""
    connect: Annotated[tuple[Endpoint, ...], Field(min_length=1)] = ("tcp/127.0.0.1:7448",)
    """zenoh endpoints of the program that publishes them."""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """How often each camera's frames come; `safety.camera_timeout_periods` counts in these."""
    speed_factor: Annotated[float, Field(ge=0.02, le=10)] = 1.0
    """How fast a simulator's time passes: at 0.5, half a second of it in each real one, and all of flockd's times and
    time-outs count in it."""


class SourceParameters(Section):
    """Where camera frames come from, and how those of several cameras become sets."""

    kind: Literal["v4l2", "gstreamer", "ros", "shared_memory"]
    """Cameras of the kernel, GStreamer pipelines, topics of ROS 2, or another program's frames."""
    cameras: tuple[CameraDeviceParameters, ...] = ()
    """For all kinds but `shared_memory`: one for each camera of the rig."""
    shared_memory: SharedMemoryParameters = SharedMemoryParameters()
    """For kind `shared_memory`."""
    set_tolerance_s: Annotated[float, Field(gt=0, le=60)] = 0.02
    """How far the time stamp of a frame may be from that of its set; half a frame period or more."""
    set_wait_s: Annotated[float, Field(gt=0, le=60)] = 0.1
    """How long a set waits for a late or lost camera."""
    silence_s: Annotated[float, Field(gt=0, le=60)] = services.FRAME_SILENCE.timeout
    """A camera without a usable frame for this long is closed and opened again."""
    frozen_after: Annotated[int, Field(ge=0)] = 5
    """An image that repeats itself this many times is frozen, and does not count; 0: it may repeat for ever."""

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
        """Width and height of the image that a camera's `crop` is cut from."""
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
"""Keys of a camera that only one kind of source has; the first says where the camera is."""
_LACKS = {
    "v4l2": "has no `device`; write the camera's path, as `flockd cameras` lists it",
    "gstreamer": "has no `pipeline`; write elements such as `v4l2src device=/dev/video0`",
    "ros": "has no `topic`; write that of its images, as `ros2 topic list` shows it",
}


def _misplaced(camera: CameraDeviceParameters, kind: str) -> dict[tuple[str, ...], str]:
    """What a camera of this kind of source must not have, by its key, or what it lacks."""
    faults: dict[tuple[str, ...], str] = {
        (key,): f"is of a source of kind `{other}`; delete it, or write `kind: {other}`"
        for other, keys in _KEYS.items()
        for key in keys
        if other != kind and getattr(camera, key) != type(camera).model_fields[key].default
        if not (camera.crop and key == "turn_deg")
    }
    if camera.crop_of is not None and camera.crop is None:
        faults["crop_of",] = "is of a `crop`, and there is none; add it, or delete this"
    if not faults and kind in _KEYS and not getattr(camera, _KEYS[kind][0]):
        faults[()] = _LACKS[kind]
    return faults
