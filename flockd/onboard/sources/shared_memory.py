"""Frames from another program on this computer through zenoh's shared memory, and the side that publishes them.

A frame is one message under `flockd-frames/v1/<drone>/<camera>`: its payload is the image, row by row, 3 bytes RGB a
pixel; its attachment says what it is in 24 bytes, little-endian: `rgb8`, width and height (uint16), sequence (uint64),
time in seconds (float64). Where shared memory cannot be had, the same messages go through the socket.
"""

from __future__ import annotations

import functools
import struct
import time
from collections.abc import Callable, Mapping, Sequence

import zenoh
from zenoh import shm

from flockd.core import services
from flockd.core.config.source import SourceParameters
from flockd.core.messages import Frame
from flockd.onboard.sources.assembler import FrameReceiver, ReceivedFrames
from flockd.onboard.sources.frames import RawFrame
from flockd.onboard.sources.image_formats import RgbFormat
from flockd.onboard.telemetry.zenoh_session import SessionError, SessionOwner, close_session, open_session

PREFIX = "flockd-frames/v1"
"""Apart from telemetry, which no drone reads."""
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7448"
_HEADER = struct.Struct("<4sHHQd")
_MAGIC = b"rgb8"
"""Largest age of a frame on arrival: a simulator stamps before it draws, and may draw for long."""
POOL_BYTES = 16 << 20
"""For one drone, in whose memory it counts: four sets of four 640x480 cameras."""


class FramePublisher(SessionOwner):
    """Publishes the frames of any number of drones; what a simulator calls. Raises UnavailableError without endpoint.

    Nothing waits for a reader: a frame that nobody can take in time is dropped on the way.
    """

    def __init__(self, *, listen: Sequence[str] = (DEFAULT_ENDPOINT,), pool_bytes: int = POOL_BYTES) -> None:
        """``pool_bytes``: of shared memory for each drone."""
        self._pool_bytes = pool_bytes
        self._session, note = _open(listen=listen, connect=())
        self._notes = [note] if note else []
        self._shares = note is None
        self._pools: dict[str, shm.ShmProvider | None] = {}
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}

    def publish(self, drone: str, frame: Frame) -> None:
        """Sends one frame; its image is copied."""
        height, width, _ = frame.image.shape
        header = _HEADER.pack(_MAGIC, width, height, frame.sequence, frame.time_s)
        self._publisher(drone, frame.camera).put(self._payload(drone, frame.image.tobytes()), attachment=header)

    def notes(self) -> tuple[str, ...]:
        """What a person should know although nothing is wrong: each is one sentence."""
        return tuple(self._notes)

    def _payload(self, drone: str, data: bytes) -> bytes | shm.ZShmMut:
        if drone not in self._pools:
            self._pools[drone] = self._pool() if self._shares else None
        pool = self._pools[drone]
        if pool is None:
            return data
        try:
            block = pool.alloc(len(data), shm.GarbageCollect())
        except zenoh.ZError as error:  # full: readers hold what they have not copied yet
            self._note(_without_shared_memory(str(error).split(" at ")[0]))
            return data
        block[:] = data
        return block

    def _pool(self) -> shm.ShmProvider | None:
        try:
            return shm.ShmProvider.default_backend(self._pool_bytes)
        except zenoh.ZError as error:
            self._note(_without_shared_memory(str(error).split(" at ")[0]))
            return None

    def _note(self, sentence: str) -> None:
        if sentence not in self._notes:
            self._notes.append(sentence)

    def _publisher(self, drone: str, camera: str) -> zenoh.Publisher:
        publisher = self._publishers.get((drone, camera))
        if publisher is None:
            publisher = self._session.declare_publisher(
                f"{PREFIX}/{drone}/{camera}", congestion_control=zenoh.CongestionControl.DROP
            )
            self._publishers[drone, camera] = publisher
        return publisher


class SharedMemorySource(ReceivedFrames):
    """A ``FrameSource`` of what a ``FramePublisher`` publishes for one drone."""

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
        self._receiver = FrameReceiver(tuple(self._formats), parameters, clock, on_frame)
        self._session: zenoh.Session | None = None
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._notes: list[str] = []

    def start(self) -> None:
        """See ``FrameSource``; raises UnavailableError for an endpoint that cannot be one."""
        self._session, note = _open(listen=(), connect=self._where.connect)
        self._notes += [note] if note else []
        self._subscribers = [
            self._session.declare_subscriber(
                f"{PREFIX}/{self._where.drone}/{camera}", functools.partial(self._receive, camera)
            )
            for camera in self._formats
        ]

    def notes(self) -> tuple[str, ...]:
        """See ``FrameSource``."""
        return tuple(self._notes)

    def stop(self) -> None:
        """See ``FrameSource``."""
        self._receiver.stop()
        if self._session is not None:
            close_session(self._session)

    def _receive(self, camera: str, sample: zenoh.Sample) -> None:
        """On a thread of zenoh's."""
        if sample.payload.as_shm() is None and not self._notes:
            self._notes.append("frames come through a socket instead of shared memory: slower, and otherwise the same")
        image_format = self._formats[camera]
        try:
            header = b"" if sample.attachment is None else sample.attachment.to_bytes()
            magic, width, height, sequence, time_s = _HEADER.unpack(header)
        except struct.error:
            magic = b""
        if magic != _MAGIC:
            self._receiver.count(camera, "received", "malformed")
            return
        if (width, height) != image_format.size:
            asked = "x".join(map(str, image_format.size))
            why = f"{camera}: frames are {width}x{height}, but the rig has {asked}; correct one"
            self._receiver.refuse(camera, "corrupt", why)
            return
        if not self._receiver.is_of_now(time_s, services.FRAME_STAMP.timeout):
            why = f"{camera}: a time stamp is not of this computer's clock; correct the program"
            self._receiver.refuse(camera, "time_stamp", why)
            return
        self._receiver.offer(RawFrame(camera, sample.payload.to_bytes(), image_format.decode, time_s, sequence))


def _open(*, listen: Sequence[str], connect: Sequence[str]) -> tuple[zenoh.Session, str | None]:
    """A session, and a note if it has to do without shared memory."""
    try:
        return open_session("frames", listen, connect, shared_memory=True), None
    except SessionError as error:
        session = open_session("frames", listen, connect, shared_memory=False)
        return session, _without_shared_memory(error.reason)


def _without_shared_memory(reason: str) -> str:
    return f"frames go through a socket instead of shared memory ({reason}): slower, and otherwise the same"
