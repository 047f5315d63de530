"""Frames as cameras send them, the devices that they come from, and the cameras' state as other parts see it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol, Self

from flockd.core.errors import UnavailableError
from flockd.core.messages import FrameSet
from flockd.onboard.sources.image_formats import Decoder, ImageFormat

Count = Literal[
    "received",  # came from the device or the network, whatever they were worth
    "used",  # handed out in a set
    "superseded",  # a newer frame was there before anybody asked
    "late",  # came when its set had already gone
    "missing",  # sets handed out without this camera
    "lost",  # never came: gaps in the sequence numbers
    "time_stamp",  # not after the one before, or not of this computer's monotonic clock
    "frozen",  # the same image or sequence number again and again
    "flagged",  # the driver itself says that the data are damaged
    "corrupt",  # wrong size, cannot be decoded, or decodes into what no camera sees
    "undecodable",  # those of the corrupt that were found so only when decoded, as few frames are
    "malformed",  # a message that is not a frame
    "opened",  # times the device was opened
]


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One image as the camera sent it: not decoded, because most frames are superseded before they are used."""

    camera: str
    data: bytes
    decode: Decoder
    """What makes an RGB image of the data."""
    time_s: float
    """Monotonic, when the image was taken."""
    sequence: int
    shared: bool = False
    """Other cameras' images are in these data too: they change when this camera's part does not."""


@dataclass(frozen=True)
class CameraStatus:
    """How one camera is doing."""

    age_s: float
    """Since its newest usable frame arrived; infinite before the first."""
    fault: str | None
    """Why no usable frames come, in one sentence; None while they do, and as long as nothing is known."""
    counts: Mapping[Count, int]
    """Since the start; a count that is missing is zero."""


class FrameSource(Protocol):
    """Cameras, wherever they are. One thread calls `newest`; the other methods are for any thread."""

    def start(self) -> None:
        """Begins to receive frames. A camera that is not there is no error: `status` says so, and it is tried again."""

    def newest(self, timeout_s: float = 0.0) -> FrameSet | None:
        """The newest set that was not handed out before, decoded by the calling thread; older ones are dropped.

        Waits up to ``timeout_s`` for one; None if none comes, and at once after `stop`.
        """

    def status(self) -> Mapping[str, CameraStatus]:
        """How each camera is doing, by its name."""

    def stop(self) -> None:
        """Closes everything; returns within a fraction of a second."""


class CameraError(UnavailableError):
    """Why a camera gives no frames, in one sentence."""


@dataclass(frozen=True, eq=False)
class CapturedBuffer:
    """What the driver handed over: one image, its time and its number."""

    data: bytes
    time_s: float
    sequence: int
    flagged: bool
    """The driver says that the data may be damaged."""


class CameraDevice(ABC):
    """An open camera that streams; a context manager that closes it. Every method raises CameraError when it fails."""

    start_s: float
    """How long it may take to its first frame."""

    @abstractmethod
    def read(self, timeout_s: float) -> CapturedBuffer | None:
        """The next image; None if there is none within the time."""

    @abstractmethod
    def image_format(self) -> ImageFormat:
        """Format of the image that `read` gave last."""

    @abstractmethod
    def close(self) -> None:
        """Stops the camera and gives it back."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
