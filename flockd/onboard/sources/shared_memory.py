"""Frames from another program on this computer through zenoh's shared memory: the source, and a publisher.

A frame is one message under `flockd-frames/v1/<drone>/<camera>`. Its payload is the image, row by row, 3 bytes RGB per
pixel. Its attachment has 24 bytes, little-endian: `rgb8`, width and height (uint16), sequence (uint64), time in seconds
(float64). Without shared memory zenoh sends it through a socket.
"""

from __future__ import annotations

import functools
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

import zenoh

from flockd.core import services
from flockd.core.config.source import SourceParameters
from flockd.core.messages import Frame
from flockd.onboard.sources.assembler import FrameReceiver
from flockd.onboard.sources.frames import RawFrame
from flockd.onboard.sources.image_formats import RgbFormat
from flockd.onboard.telemetry.zenoh_session import SessionError, SessionOwner, close_session, open_session

PREFIX = "flockd-frames/v1"
"""Not below telemetry's keys: no drone reads telemetry."""
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7448"
_HEADER = struct.Struct("<4sHHQd")
_MAGIC = b"rgb8"


class FramePublisher(SessionOwner):
    """Publishes the frames of any number of drones, for simulators. Raises UnavailableError for an unusable endpoint.

    It never waits: a frame is dropped if its reader is too slow.
    """

    def __init__(self, *, listen: Sequence[str] = (DEFAULT_ENDPOINT,)) -> None:
        self._session = _open(listen=listen, connect=())
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}

    def publish(self, drone: str, frame: Frame) -> None:
        """Sends one frame; its image is copied."""
        height, width, _ = frame.image.shape
        header = _HEADER.pack(_MAGIC, width, height, frame.sequence, frame.time_s)
        self._publisher(drone, frame.camera).put(frame.image.tobytes(), attachment=header)

    def _publisher(self, drone: str, camera: str) -> zenoh.Publisher:
        publisher = self._publishers.get((drone, camera))
        if publisher is None:
            publisher = self._session.declare_publisher(
                f"{PREFIX}/{drone}/{camera}", congestion_control=zenoh.CongestionControl.DROP
            )
            self._publishers[drone, camera] = publisher
        return publisher


class SharedMemorySource(FrameReceiver):
    """A ``FrameSource`` for the frames that a ``FramePublisher`` publishes for one drone."""

    def __init__(
        self,
        sizes: Mapping[str, tuple[int, int]],
        parameters: SourceParameters,
        clock: Callable[[], float] = time.monotonic,
        on_frame: Callable[[RawFrame], None] = lambda frame: None,
    ) -> None:
        """``sizes``: width, height by camera; ``on_frame``: called with each usable frame, on a thread of zenoh's."""
        self._formats = {camera: RgbFormat(size) for camera, size in sizes.items()}
        self._where = parameters.shared_memory
        super().__init__(tuple(self._formats), parameters, clock, on_frame)
        self._session: zenoh.Session | None = None
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def start(self) -> None:
        """See ``FrameSource``. Raises UnavailableError for an invalid endpoint."""
        self._session = _open(listen=(), connect=self._where.connect)
        self._subscribers = [
            self._session.declare_subscriber(
                f"{PREFIX}/{self._where.drone}/{camera}", functools.partial(self._receive, camera)
            )
            for camera in self._formats
        ]

    def stop(self) -> None:
        """See ``FrameSource``."""
        super().stop()
        if self._session is not None:
            close_session(self._session)

    def _receive(self, camera: str, sample: zenoh.Sample) -> None:
        """Called on a thread of zenoh's."""
        image_format = self._formats[camera]
        try:
            header = b"" if sample.attachment is None else sample.attachment.to_bytes()
            magic, width, height, sequence, time_s = _HEADER.unpack(header)
        except struct.error:
            magic = b""
        if magic != _MAGIC:
            self.count(camera, "received", "malformed")
            return
        if (width, height) != image_format.size:
            asked = "x".join(map(str, image_format.size))
            why = f"{camera}: frames are {width}x{height}, but the rig has {asked}; correct one"
            self.refuse(camera, "corrupt", why)
            return
        if not self.is_of_now(time_s, services.FRAME_STAMP.timeout):
            why = f"{camera}: a time stamp is not on this computer's clock; correct the program that sends it"
            self.refuse(camera, "time_stamp", why)
            return
        self.offer(RawFrame(camera, sample.payload.to_bytes(), image_format.pixels, time_s, sequence))


def _open(*, listen: Sequence[str], connect: Sequence[str]) -> zenoh.Session:
    """Opens a session, with shared memory if this computer has it."""
    with suppress(SessionError):
        return open_session("frames", listen, connect, shared_memory=True)
    return open_session("frames", listen, connect, shared_memory=False)
