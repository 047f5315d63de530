"""The interfaces of sources and camera devices, raw frames, and the status of a camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol, Self

from flockd.core.errors import UnavailableError
from flockd.core.messages import FrameSet
from flockd.onboard.sources.image_formats import Decoder, ImageFormat

Count = Literal[
    "received",  # all frames that arrived, usable or not
    "used",  # returned in a set
    "superseded",  # dropped for a newer one
    "late",  # arrived after a set of its time was returned
    "missing",  # sets without this camera
    "lost",  # gaps in the sequence numbers
    "time_stamp",  # not later than the one before, or not on this computer's monotonic clock
    "frozen",  # the same image or sequence number repeated
    "flagged",  # marked as damaged by the driver
    "corrupt",  # wrong size, not decodable, or of one colour
    "undecodable",  # those of the corrupt that were noticed only when decoded; few frames are
    "malformed",  # a message that is not a frame
    "opened",  # how often the device was opened
]


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One image as the camera sent it. It is decoded only if it is used: most frames are superseded."""

    camera: str
    data: bytes
    decode: Decoder
    """Converts the data to an RGB image."""
    time_s: float
    """Capture time, monotonic."""
    sequence: int
    shared: bool = False
    """Whether the data contain images of other cameras too, so that they change even if this camera's part does not."""


@dataclass(frozen=True)
class CameraStatus:
    """Status of one camera."""

    age_s: float
    """Time since its newest usable frame arrived; infinite before the first."""
    fault: str | None
    """Why no usable frames arrive, in one sentence; None: they do, or the reason is not known yet."""
    counts: Mapping[Count, int]
    """Since the start; a count that is missing is zero."""


class FrameSource(Protocol):
    """A source of camera frames. Call `newest` on one thread; the other methods on any."""

    def start(self) -> None:
        """Begins to receive frames. A missing camera raises no error: `status` reports it, and it is tried again."""

    def newest(self, timeout_s: float = 0.0) -> FrameSet | None:
        """The newest set that was not returned before, decoded on the calling thread; older ones are dropped.

        Waits up to ``timeout_s``. None: no set came, or the source was stopped.
        """

    def status(self) -> Mapping[str, CameraStatus]:
        """The status of each camera, by name."""

    def stop(self) -> None:
        """Closes everything; returns within a fraction of a second."""


class CameraError(UnavailableError):
    """A camera delivers no frames; the text, one sentence, says why."""


@dataclass(frozen=True, eq=False)
class CapturedBuffer:
    """One image as the driver delivered it, with its time and number."""

    data: bytes
    time_s: float
    sequence: int
    flagged: bool
    """Whether the driver marked the data as possibly damaged."""


class CameraDevice(ABC):
    """An open camera that streams; a context manager that closes it. Every method may raise CameraError."""

    start_s: float
    """Longest time to its first frame."""

    @abstractmethod
    def read(self, timeout_s: float) -> CapturedBuffer | None:
        """The next image; None if no image comes within ``timeout_s``."""

    @abstractmethod
    def image_format(self) -> ImageFormat:
        """The format of the image that `read` returned last."""

    @abstractmethod
    def close(self) -> None:
        """Stops the camera and releases it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
