"""What every method of optical flow offers."""

from __future__ import annotations

from typing import Protocol

from flockd.core.messages import Float32Array, UInt8Array


class Flow(Protocol):
    """Where every pixel of the first image has gone in the second."""

    name: str

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2) pixels right and down."""
        ...
