"""A camera on topics of ROS 2, Image or CompressedImage with CameraInfo, read in a separate process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from flockd.core.config.rig import IntrinsicsConfig, field_of_view_deg
from flockd.core.config.source import CameraDeviceParameters
from flockd.onboard.sources.camera_child import COMPRESSED, IMAGE, IMAGE_HEAD, INFO, INFO_BODY, NO_ROS
from flockd.onboard.sources.child_device import ROS_CHILD, ChildDevice, ChildMessage
from flockd.onboard.sources.frames import CameraError, CapturedBuffer
from flockd.onboard.sources.image_formats import ImageFormat, MjpegFormat, PackedFormat

ENCODINGS: Mapping[str, str] = {
    "rgb8": "RGB",
    "bgr8": "BGR",
    "rgba8": "RGBA",
    "bgra8": "BGRA",
    "8UC3": "BGR",
    "mono8": "GRAY8",
    "8UC1": "GRAY8",
    "yuv422_yuy2": "YUY2",
    "yuyv": "YUY2",
    "yuv422": "UYVY",
    "uyvy": "UYVY",
}
"""GStreamer's name for each encoding of `sensor_msgs/image_encodings` that can be decoded."""
CENTRE_PX = 0.5
"""ROS and its tools have pixel centres at whole numbers, flockd at +0.5."""
LENS_TOLERANCE = 0.03
"""Largest difference between a driver's CameraInfo and the rig, as a share of the focal length: two calibrations of
one camera differ."""


def info_topic_of(topic: str) -> str:
    """The topic of a camera's CameraInfo by the convention of ROS: beside the images, whatever their transport."""
    base = topic.removesuffix("/compressed")
    return f"{base.rpartition('/')[0]}/camera_info"


def ros_format(
    encoding: str,
    size: tuple[int, int] | None,
    bytes_per_line: int | None,
    wanted: tuple[int, int],
    size_words: tuple[str, str],
) -> ImageFormat:
    """The format of a message's image. Raises ValueError if it cannot be decoded or is not of the size ``wanted``.

    ``encoding``: of an Image, or the `format` of a CompressedImage, whose ``size`` is None. ``size_words``: see
    `CameraDeviceParameters.size_words`.
    """
    if size is None:
        if "compressedDepth" not in encoding and ("jpeg" in encoding or "jpg" in encoding):
            return MjpegFormat(wanted)
        raise ValueError(f"sends {encoding[:40]!r}; let its transport send JPEG")
    if size != wanted:
        told = f"gives {size[0]}x{size[1]}, but {size_words[0]} {wanted[0]}x{wanted[1]}"
        raise ValueError(f"{told}; correct {size_words[1]}, or the driver")
    if encoding not in ENCODINGS:
        known = ", ".join(ENCODINGS)
        raise ValueError(f"has the encoding {encoding[:40]!r}, and not one of {known}; convert it, as image_proc does")
    return PackedFormat(ENCODINGS[encoding], wanted, bytes_per_line)


def info_fault(lens: IntrinsicsConfig, wanted: tuple[int, int], topic: str, found: Sequence[float]) -> str | None:
    """How a CameraInfo contradicts the rig; None: it agrees, or is uncalibrated.

    ``topic``: of the images; rectified ones have the CameraInfo of those before. ``found``: see `numbers_of`. Pixel
    centres are at whole numbers in ROS.
    """
    width, height, fx, fy, cx, cy, *k, fisheye = found
    if fx == 0:
        return None
    if (width, height) != wanted:
        return f"is of {width}x{height}, but the rig has {wanted[0]}x{wanted[1]}; correct one"
    for key, value in {"fx": fx, "fy": fy, "cx": cx + CENTRE_PX, "cy": cy + CENTRE_PX}.items():
        expected = getattr(lens, key)
        if not abs(value - expected) <= LENS_TOLERANCE * lens.fx:
            return f"has {key} {value:.1f}, but the rig {expected:.1f}; correct one"
    kind = {"model": "wide_angle", "distortion": k[:4]} if fisheye else {"model": "pinhole", "distortion": k}
    seen, expected = (field_of_view_deg(one, wanted) for one in (lens.model_copy(update={**kind, "fx": fx}), lens))
    if "rect" not in topic and abs(seen - expected) > LENS_TOLERANCE * expected:
        return f"shows {seen:.0f} degrees by its D, but the rig {expected:.0f}; correct one"
    return None


class RosDevice(ChildDevice):
    """A ``CameraDevice`` for a topic. Time stamps are those of the messages, converted to CLOCK_MONOTONIC."""

    _what, _kinds = "its topic", (IMAGE, COMPRESSED, INFO)

    def __init__(
        self,
        camera: CameraDeviceParameters,
        size: tuple[int, int],
        lens: IntrinsicsConfig | None = None,
        command: Sequence[str] = ROS_CHILD,
    ) -> None:
        """Starts the process. ``lens``: the rig's intrinsics, which CameraInfo must agree with. Raises CameraError."""
        self._topic, self._lens = camera.place, lens
        self._info_topic = camera.camera_info or info_topic_of(camera.place)
        super().__init__(camera, size, [*command, "ros", camera.place, self._info_topic, camera.stamps])

    def _taken(self, message: ChildMessage) -> CapturedBuffer | None:
        if message.kind == INFO:
            self._compare(INFO_BODY.unpack(message.data))
            return None
        text, width, height, bytes_per_line = IMAGE_HEAD.unpack_from(message.data)
        encoding = text.rstrip(b"\0").decode("utf-8", "replace")
        size = None if message.kind == COMPRESSED else (width, height)
        try:
            self._format = ros_format(encoding, size, bytes_per_line, self._size, self._size_words)
        except ValueError as error:
            raise CameraError(f"{self._name}: {self._topic} {error}") from None
        return self._captured(message.data[IMAGE_HEAD.size :], message)

    def _compare(self, numbers: Sequence[float]) -> None:
        """Raises CameraError if a calibrated CameraInfo contradicts the rig."""
        if self._lens is None:
            return
        if (fault := info_fault(self._lens, self._size, self._topic, numbers)) is not None:
            raise CameraError(f"{self._name}: {self._info_topic} {fault}")

    def _failed(self, reason: str) -> CameraError:
        if reason == NO_ROS:
            return CameraError(
                f"{self._name}: {reason}; source a ROS 2, or, with Python 3.11 on x86-64, pip install -e '.[ros]'"
            )
        hint = "name a topic of Image or CompressedImage" if reason.startswith("is of") else "check its environment"
        return CameraError(f"{self._name}: {self._topic} {reason}; {hint}")
