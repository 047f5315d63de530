"""A camera that sends its images to a pipeline as datagrams, each with the time at which it was sent in its pixels."""

from __future__ import annotations

import socket
import struct
import threading
import time
from types import TracebackType
from typing import Self

import numpy as np

SIZE = (96, 64)
"""Width, height; an image of grey values fits into a datagram."""
_TIME = struct.Struct("<q")


class DatagramCamera:
    """Sends from a thread, between ``__enter__`` and ``__exit__``. Its attributes say what, and may be changed."""

    def __init__(self, rate_hz: float) -> None:
        self.silent = False
        self.frozen = False
        self.cut = False
        """Whether images lack their second half."""
        self._rate_hz = rate_hz
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_free:
            any_free.bind(("127.0.0.1", 0))
            self._port = any_free.getsockname()[1]

    @property
    def pipeline(self) -> str:
        """That receives the images."""
        kind = f"video/x-raw,format=GRAY8,width={SIZE[0]},height={SIZE[1]},framerate={round(self._rate_hz)}/1"
        return f'udpsrc address=127.0.0.1 port={self._port} caps="{kind}"'

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def _send(self) -> None:
        noise = np.random.default_rng(0).integers(0, 256, SIZE[0] * SIZE[1], np.uint8).tobytes()[_TIME.size :]
        due_s, stamp = time.monotonic(), b""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._ended.wait(max(due_s - time.monotonic(), 0.0)):
                due_s = max(due_s + 1.0 / self._rate_hz, time.monotonic())
                stamp = stamp if self.frozen and stamp else _TIME.pack(time.monotonic_ns())
                if not self.silent:
                    image = stamp + noise
                    sender.sendto(image[: len(image) // 2] if self.cut else image, ("127.0.0.1", self._port))


def sent_s(image: bytes) -> float:
    """When an image was sent, on the monotonic clock."""
    return float(_TIME.unpack_from(image)[0]) * 1e-9
