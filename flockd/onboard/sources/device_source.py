"""Cameras of this computer: a thread for each reads its frames, and opens it again if it fails or falls silent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from flockd.core.config.rig import IntrinsicsConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.secrets import masked
from flockd.onboard.sources.assembler import FrameReceiver
from flockd.onboard.sources.child_device import CHILD, ROS_CHILD
from flockd.onboard.sources.frames import CameraDevice, CameraError, CapturedBuffer, Count, RawFrame
from flockd.onboard.sources.gstreamer_device import GstreamerDevice
from flockd.onboard.sources.image_formats import CapturedImage, CorruptImageError, ImageFormat
from flockd.onboard.sources.ros_device import RosDevice
from flockd.onboard.sources.v4l2_device import V4l2Device
from flockd.onboard.sources.v4l2_kernel import Kernel

_LOOK_S = 0.05
"""Interval at which a thread without frames checks whether it should stop."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
_STOP_S = 1.0
"""Time for threads to stop; one that hangs in a driver for longer ends with the process."""


@dataclass(frozen=True)
class Devices:
    """Opens cameras: each pipeline or topic in a process of its own, all others through the ``kernel``."""

    kernel: Kernel = field(default_factory=Kernel)
    command: Sequence[str] = CHILD
    ros_command: Sequence[str] = ROS_CHILD
    lenses: Mapping[str, IntrinsicsConfig] = field(default_factory=dict)
    """Intrinsics in the rig, by camera; a topic's CameraInfo must agree with them."""

    def open(self, camera: CameraDeviceParameters, size: tuple[int, int]) -> CameraDevice:
        """Opens and starts a camera for images of this ``size``, width and height. Raises CameraError."""
        if camera.pipeline:
            return GstreamerDevice(camera, size, self.command)
        if camera.topic:
            lens = None if camera.crop else self.lenses.get(camera.name)
            return RosDevice(camera, size, lens, self.ros_command)
        return V4l2Device(camera, size, self.kernel)


class DeviceSource(FrameReceiver):
    """A ``FrameSource`` for V4L2 cameras, GStreamer pipelines and ROS topics, with the stamps and numbers they give."""

    def __init__(
        self,
        sizes: Mapping[str, tuple[int, int]],
        parameters: SourceParameters,
        devices: Devices | None = None,
        on_frame: Callable[[RawFrame], None] = lambda frame: None,
    ) -> None:
        """``sizes``: width and height of each camera in ``parameters``, by name.

        ``on_frame`` is called with each usable frame, on its camera's thread.
        """
        super().__init__(tuple(sizes), parameters, on_frame=on_frame)
        by_image: dict[str, list[CameraDeviceParameters]] = {}
        for camera in parameters.cameras:
            by_image.setdefault(camera.place if camera.crop else camera.name, []).append(camera)
        self._cameras = []
        for cameras in by_image.values():
            first, size = cameras[0], sizes[cameras[0].name]
            if first.crop is not None:
                width, height = parameters.whole_px(first)
                size = width // first.reduce, height // first.reduce
            elif first.turn_deg % 180:
                size = size[1], size[0]
            self._cameras.append(_Device(cameras, size, parameters.silence_s, self, devices or Devices()))

    def start(self) -> None:
        """See ``FrameSource``."""
        for camera in self._cameras:
            camera.start()

    def stop(self) -> None:
        """See ``FrameSource``."""
        super().stop()
        for camera in self._cameras:
            camera.stopping.set()
        until_s = time.monotonic() + _STOP_S
        for camera in filter(threading.Thread.is_alive, self._cameras):
            camera.join(max(until_s - time.monotonic(), 0.0))


class _Device(threading.Thread):
    """The thread that keeps one device running, for one camera or for several that are cut from its images."""

    def __init__(
        self,
        cameras: Sequence[CameraDeviceParameters],
        size: tuple[int, int],
        silence_s: float,
        receiver: FrameReceiver,
        devices: Devices,
    ) -> None:
        first = cameras[0]
        super().__init__(name=f"camera-{first.name}", daemon=True)
        self._parameters, self._cameras, self._size, self._silence_s = first, cameras, size, silence_s
        self._receiver, self._devices = receiver, devices
        self._who = first.name
        self._delivered = False
        """Whether the device has delivered a usable frame since it was last opened."""
        self._has_delivered = False
        """Whether it has delivered one at all."""
        self.stopping = threading.Event()

    def run(self) -> None:
        """Runs until ``stopping`` is set."""
        pause_s = _FIRST_PAUSE_S
        while not self.stopping.is_set():
            self._delivered = False
            try:
                with self._devices.open(self._parameters, self._size) as device:
                    self._count("opened")
                    self._capture(device)
            except CameraError as error:
                self._fault(str(error).removeprefix(f"{self._who}: "))
            except Exception as error:  # noqa: BLE001 - an unexpected error is the camera's fault, not the thread's end
                self._fault(f"cannot be run ({type(error).__name__}: {error})")
            pause_s = _FIRST_PAUSE_S if self._delivered else pause_s
            self.stopping.wait(pause_s)
            pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    def _capture(self, device: CameraDevice) -> None:
        """Reads frames until ``stopping`` is set. Raises CameraError if the camera fails or falls silent."""
        usable_s, refused = time.monotonic(), None
        left_over = self._has_delivered  # a driver may first repeat the last old image, with a new stamp
        while not self.stopping.is_set():
            captured = device.read(_LOOK_S)
            if captured is not None and left_over:
                self._count("received", "late")
                left_over = False
            elif captured is not None:
                refused = self._take(captured, device.image_format())
                if refused is None:
                    usable_s, self._delivered, self._has_delivered = time.monotonic(), True, True
            limit_s = self._silence_s if self._delivered else max(device.start_s, self._silence_s)
            if time.monotonic() - usable_s > limit_s:
                last = f" (the last was refused: {refused.replace('_', ' ')})" if refused else ""
                raise CameraError(
                    f"{self._who}: {masked(self._parameters.place)} gave no usable image for {limit_s:g} s{last}"
                )

    def _take(self, captured: CapturedBuffer, image_format: ImageFormat) -> Count | None:
        refused: Count | None = "flagged" if captured.flagged else None
        # Some drivers do not report the clock of their stamps: a stamp near now is on this computer's.
        if refused is None and not self._receiver.is_of_now(captured.time_s, self._silence_s):
            refused = "time_stamp"
        try:
            image_format.check(captured.data)
        except CorruptImageError:
            refused = refused or "corrupt"
        if refused is not None:
            self._count("received", refused)
            return refused
        taken = [self._receiver.offer(frame) for frame in frames_of(self._cameras, captured, image_format)]
        return None if None in taken else taken[0]

    def _count(self, *what: Count) -> None:
        for camera in self._cameras:
            self._receiver.count(camera.name, *what)

    def _fault(self, sentence: str) -> None:
        for camera in self._cameras:
            self._receiver.fault(camera.name, f"{camera.name}: {sentence}")


def frames_of(
    cameras: Sequence[CameraDeviceParameters], captured: CapturedBuffer, image_format: ImageFormat
) -> Iterator[RawFrame]:
    """The frames of all cameras that are cut from one image; they share its data."""
    image = CapturedImage(image_format)
    for camera in cameras:
        decode, shared = image.decoder(camera), camera.crop is not None
        yield RawFrame(camera.name, captured.data, decode, captured.time_s, captured.sequence, shared)
