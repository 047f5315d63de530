"""One camera behind topics of ROS 2: Image or CompressedImage with CameraInfo, fetched by a process of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from flockd.core.config.rig import IntrinsicsConfig
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
"""What is read of `sensor_msgs/image_encodings`, by GStreamer's name."""
CENTRE_PX = 0.5
"""ROS and its tools have pixel centres at whole numbers, flockd at +0.5."""
LENS_TOLERANCE = 0.03
"""By so much of the focal length a driver's CameraInfo and the rig may be apart: two calibrations of one camera are."""


def info_topic_of(topic: str) -> str:
    """Where a camera's CameraInfo is by the ecosystem's custom: beside the images, whatever transport carries them."""
    base = topic.removesuffix("/compressed")
    return f"{base.rpartition('/')[0]}/camera_info"


class RosDevice(ChildDevice):
    """A ``CameraDevice`` of a topic. Its time stamps are the messages' own, carried over to CLOCK_MONOTONIC."""

    _what, _kinds = "its topic", (IMAGE, COMPRESSED, INFO)

    def __init__(
        self,
        camera: CameraDeviceParameters,
        size: tuple[int, int],
        lens: IntrinsicsConfig | None = None,
        command: Sequence[str] = ROS_CHILD,
    ) -> None:
        """Starts the process; ``lens``: of the rig, which a CameraInfo must not contradict. Raises CameraError."""
        self._topic, self._lens = camera.place, lens
        self._info_topic = camera.camera_info or info_topic_of(camera.place)
        super().__init__(camera, size, [*command, "ros", camera.place, self._info_topic, camera.stamps])

    def _taken(self, message: ChildMessage) -> CapturedBuffer | None:
        if message.kind == INFO:
            self._compare(*INFO_BODY.unpack(message.data))
            return None
        text, width, height, bytes_per_line = IMAGE_HEAD.unpack_from(message.data)
        encoding = text.rstrip(b"\0").decode("utf-8", "replace")
        if message.kind == IMAGE:
            self._format = self._packed(encoding, (width, height), bytes_per_line)
        elif "jpeg" in encoding or "jpg" in encoding:
            self._format = MjpegFormat(self._size)
        else:
            raise CameraError(f"{self._name}: {self._topic} sends {encoding[:40]!r}; let its transport send JPEG")
        return self._captured(message.data[IMAGE_HEAD.size :], message)

    def _packed(self, encoding: str, size: tuple[int, int], bytes_per_line: int) -> ImageFormat:
        self._check_size(size, f"{self._topic} gives", "correct size_px, or the driver")
        if encoding not in ENCODINGS:
            known = ", ".join(ENCODINGS)
            raise CameraError(
                f"{self._name}: {self._topic} has the encoding {encoding[:40]!r}, and not one of {known}; "
                "convert it, as image_proc does"
            )
        return PackedFormat(ENCODINGS[encoding], self._size, bytes_per_line)

    def _compare(self, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> None:
        """Raises CameraError where a CameraInfo says something else than the rig. One without a calibration may.

        Pixel centres are at whole numbers in ROS.
        """
        if self._lens is None or fx == 0:
            return
        self._check_size((width, height), f"{self._info_topic} is of", "correct one")
        found = {"fx": fx, "fy": fy, "cx": cx + CENTRE_PX, "cy": cy + CENTRE_PX}
        for key, value in found.items():
            expected = getattr(self._lens, key)
            if not abs(value - expected) <= LENS_TOLERANCE * self._lens.fx:
                raise CameraError(
                    f"{self._name}: {self._info_topic} has {key} {value:.1f}, but the rig {expected:.1f}; correct one"
                )

    def _failed(self, reason: str) -> CameraError:
        if reason == NO_ROS:
            return CameraError(
                f"{self._name}: {reason}; source a ROS 2, or, with Python 3.11 on x86-64, pip install -e '.[ros]'"
            )
        hint = "name a topic of Image or CompressedImage" if reason.startswith("is of") else "check its environment"
        return CameraError(f"{self._name}: {self._topic} {reason}; {hint}")
