"""The networks on a worker of their own, with a deadline for each call: end the run, then the worker, then give up."""

from __future__ import annotations

import concurrent.futures
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from flockd.core.messages import Float32Array, Frame, UInt8Array
from flockd.flight.geometry import RigCamera
from flockd.flight.perception import Crop, Networks, RangeEstimate, SceneMaps
from flockd.onboard.daemon.worker import Worker

TERMINATE_S = 0.5
"""How long a run may take to end when told to; ONNX Runtime takes a few milliseconds."""
MAX_ABANDONED = 2
"""Workers given up in a row by calls of one kind, before only a new process can help."""


class InterruptibleNetworks(Networks, Protocol):
    """Networks whose runs can be ended."""

    def terminate(self) -> None:
        """Ends every call under way, from any thread."""


class NetworkStuckError(Exception):
    """A network call passed its deadline."""


class WatchedNetworks:
    """`Networks` in front of others; one thread calls it, the counts are for any thread."""

    def __init__(self, networks: InterruptibleNetworks, deadline_s: float) -> None:
        self.second_stage = networks.second_stage
        self.map_stride = networks.map_stride
        self._networks = networks
        self._deadline_s = deadline_s
        self._worker = Worker("networks")
        self._abandoned: Counter[str] = Counter()
        """Workers given up since the last call of that name returned."""
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
        return max(self._abandoned.values(), default=0) >= MAX_ABANDONED

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """Raises NetworkStuckError; so do the next two."""
        result: Float32Array = self._call("flow", self._networks.flow, first, second, labels)
        return result

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """Depth and drones of one image."""
        result: SceneMaps = self._call("scene", self._networks.scene, frame, camera, ground)
        return result

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each crop."""
        result: tuple[RangeEstimate, ...] = self._call("ranges", self._networks.ranges, crops)
        return result

    def leave(self) -> None:
        """Ends the running call and refuses later ones; returns within a fraction of a second, on any thread."""
        self._left = True
        self._networks.terminate()
        self._worker.leave(TERMINATE_S)

    def _call(self, kind: str, function: Callable[..., Any], *arguments: object) -> Any:
        if self._left:
            raise NetworkStuckError("the networks have been stopped")
        call = self._worker.submit(function, *arguments)
        if not self._done_within(call, self._deadline_s):
            self._end(kind, call)
            raise NetworkStuckError(f"a network call took longer than {self._deadline_s:g} s")
        self.stuck = False
        self._abandoned[kind] = 0
        try:
            return call.result()
        except FloatingPointError:
            self.faults += 1
            raise

    def _end(self, kind: str, call: concurrent.futures.Future[Any]) -> None:
        self.stuck = True
        self.ended += 1
        self._networks.terminate()
        if not self._done_within(call, TERMINATE_S):
            self._abandoned[kind] += 1
            self._worker.leave()
            self._worker = Worker("networks")

    @staticmethod
    def _done_within(call: concurrent.futures.Future[Any], timeout_s: float) -> bool:
        return bool(concurrent.futures.wait([call], timeout_s).done)
