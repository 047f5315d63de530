"""Cameras of this computer: one thread each fetches its frames, notices silence, and opens it again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from flockd.core.config.rig import IntrinsicsConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.secrets import masked
from flockd.onboard.sources.assembler import FrameReceiver
from flockd.onboard.sources.child_device import CHILD, ROS_CHILD
from flockd.onboard.sources.frames import CameraDevice, CameraError, CapturedBuffer, Count, RawFrame
from flockd.onboard.sources.gstreamer_device import GstreamerDevice
from flockd.onboard.sources.image_formats import CorruptImageError, ImageFormat
from flockd.onboard.sources.ros_device import RosDevice
from flockd.onboard.sources.v4l2_device import V4l2Device
from flockd.onboard.sources.v4l2_kernel import Kernel

_LOOK_S = 0.05
"""How long a thread waits for a frame before it checks whether it should stop."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
_STOP_S = 1.0
"""A thread that hangs in a driver for longer is left to end with the process."""


@dataclass(frozen=True)
class Devices:
    """Opens cameras: those with a pipeline or a topic by a process each, all others by the ``kernel``."""

    kernel: Kernel = field(default_factory=Kernel)
    command: Sequence[str] = CHILD
    ros_command: Sequence[str] = ROS_CHILD
    lenses: Mapping[str, IntrinsicsConfig] = field(default_factory=dict)
    """Of the rig, by camera: what a topic's CameraInfo must not contradict."""

    def open(self, camera: CameraDeviceParameters, size: tuple[int, int]) -> CameraDevice:
        """The camera, set up for images of this width and height, and started. Raises CameraError."""
        if camera.pipeline:
            return GstreamerDevice(camera, size, self.command)
        if camera.topic:
            return RosDevice(camera, size, self.lenses.get(camera.name), self.ros_command)
        return V4l2Device(camera, size, self.kernel)


class DeviceSource(FrameReceiver):
    """A ``FrameSource`` of the kernel's cameras, pipelines and topics, with their own time stamps and numbers."""

    def __init__(
        self,
        sizes: Mapping[str, tuple[int, int]],
        parameters: SourceParameters,
        devices: Devices | None = None,
        on_frame: Callable[[RawFrame], None] = lambda frame: None,
    ) -> None:
        """``sizes``: width and height by camera, each of which has its entry in ``parameters``.

        ``on_frame`` is called with each usable frame, on its camera's thread.
        """
        super().__init__(tuple(sizes), parameters, on_frame=on_frame)
        self._cameras = [
            _Camera(camera, sizes[camera.name], parameters.silence_s, self, devices or Devices())
            for camera in parameters.cameras
        ]

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


class _Camera(threading.Thread):
    """The thread that keeps one camera running."""

    def __init__(
        self,
        parameters: CameraDeviceParameters,
        size: tuple[int, int],
        silence_s: float,
        receiver: FrameReceiver,
        devices: Devices,
    ) -> None:
        super().__init__(name=f"camera-{parameters.name}", daemon=True)
        self._parameters, self._size, self._silence_s = parameters, size, silence_s
        self._receiver, self._devices = receiver, devices
        self._who = parameters.name
        self._delivered = False
        """Whether this opening of the device has brought a usable frame."""
        self._has_delivered = False
        """Whether any has."""
        self.stopping = threading.Event()

    def run(self) -> None:
        """Until ``stopping`` is set."""
        pause_s = _FIRST_PAUSE_S
        while not self.stopping.is_set():
            self._delivered = False
            try:
                with self._devices.open(self._parameters, self._size) as device:
                    self._receiver.count(self._who, "opened")
                    self._capture(device)
            except CameraError as error:
                self._receiver.fault(self._who, str(error))
            except Exception as error:  # noqa: BLE001 - the thread's border: a camera that fails so is seen, too
                self._receiver.fault(self._who, f"{self._who}: cannot be run ({type(error).__name__}: {error})")
            pause_s = _FIRST_PAUSE_S if self._delivered else pause_s
            self.stopping.wait(pause_s)
            pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    def _capture(self, device: CameraDevice) -> None:
        """Until it is asked to stop; raises CameraError when the camera fails or falls silent."""
        usable_s, refused = time.monotonic(), None
        left_over = self._has_delivered  # drivers may begin again with the last image of before, stamped as of now
        while not self.stopping.is_set():
            captured = device.read(_LOOK_S)
            if captured is not None and left_over:
                self._receiver.count(self._who, "received", "late")
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
        # Some drivers do not say which clock is in their stamps: what is of now is of ours.
        if refused is None and not self._receiver.is_of_now(captured.time_s, self._silence_s):
            refused = "time_stamp"
        try:
            image_format.check(captured.data)
        except CorruptImageError:
            refused = refused or "corrupt"
        if refused is not None:
            self._receiver.count(self._who, "received", refused)
            return refused
        frame = RawFrame(self._who, captured.data, image_format.decode, captured.time_s, captured.sequence)
        return self._receiver.offer(frame)
