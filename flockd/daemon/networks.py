"""The networks on a worker of their own, with a deadline for each call: end the run, then the worker, then give up."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from flockd.daemon.worker import Worker
from flockd.messages import Float32Array, UInt8Array
from flockd.perception import Picture, RangeEstimate, SceneMaps
from flockd.pilot import Perceiver

TERMINATE_S = 0.5
"""How long a run may take to end when told to; ONNX Runtime takes a few milliseconds."""
MAX_ABANDONED = 2
"""Workers given up in a row, before only a new process can help."""


class Networks(Perceiver, Protocol):
    """A perceiver that can be interrupted."""

    def terminate(self) -> None:
        """Ends every call under way, from any thread."""


class NetworkStuckError(Exception):
    """A network call passed its deadline."""


class WatchedNetworks:
    """A `Perceiver` in front of another; one thread calls it, the counts are for any thread."""

    def __init__(self, networks: Networks, deadline_s: float) -> None:
        self.picture_size = networks.picture_size
        self.map_scale = networks.map_scale
        self._networks = networks
        self._deadline_s = deadline_s
        self._worker = Worker("networks")
        self._abandoned = 0
        self._left = False
        self.stuck = False
        """The last call passed its deadline."""
        self.faults = 0
        """Outputs that were not finite, since the start."""
        self.ended = 0
        """Calls that were ended, since the start."""

    @property
    def hopeless(self) -> bool:
        """Only a new process can help."""
        return self._abandoned >= MAX_ABANDONED

    @property
    def has_distance(self) -> bool:
        """See `Perceiver`, and so for the next three."""
        return self._networks.has_distance

    def flow(self, camera: str, first: UInt8Array, second: UInt8Array, labels: UInt8Array) -> Float32Array:
        """Raises NetworkStuckError; so do the next two."""
        result: Float32Array = self._call(self._networks.flow, camera, first, second, labels)
        return result

    def scene(self, camera: str, image: UInt8Array, geometry: Float32Array) -> SceneMaps:
        """Depth and drones of one image."""
        result: SceneMaps = self._call(self._networks.scene, camera, image, geometry)
        return result

    def ranges(self, pictures: Sequence[Picture]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each picture."""
        result: tuple[RangeEstimate, ...] = self._call(self._networks.ranges, pictures)
        return result

    def leave(self) -> None:
        """Ends the running call and refuses later ones; returns within a fraction of a second, on any thread."""
        self._left = True
        self._networks.terminate()
        self._worker.leave(TERMINATE_S)

    def _call(self, function: Callable[..., Any], *arguments: object) -> Any:
        if self._left:
            raise NetworkStuckError("the networks have been stopped")
        call = self._worker.submit(function, *arguments)
        if not self._done_within(call, self._deadline_s):
            self._end(call)
            raise NetworkStuckError(f"a network call took longer than {self._deadline_s:g} s")
        self.stuck = False
        self._abandoned = 0
        try:
            return call.result()
        except FloatingPointError:
            self.faults += 1
            raise

    def _end(self, call: concurrent.futures.Future[Any]) -> None:
        self.stuck = True
        self.ended += 1
        self._networks.terminate()
        if not self._done_within(call, TERMINATE_S):
            self._abandoned += 1
            self._worker.leave()
            self._worker = Worker("networks")

    @staticmethod
    def _done_within(call: concurrent.futures.Future[Any], timeout_s: float) -> bool:
        return bool(concurrent.futures.wait([call], timeout_s).done)
