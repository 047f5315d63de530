"""What every kind of camera device has in common for the code that runs it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

from flockd.core.errors import UnavailableError
from flockd.onboard.sources.image_formats import ImageFormat


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
