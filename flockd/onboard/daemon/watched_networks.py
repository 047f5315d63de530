"""The networks on a worker of their own, with a deadline for each call: end the run, then the worker, then give up."""

from __future__ import annotations

import concurrent.futures
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from flockd.core.messages import Float32Array
from flockd.flight.perception import Crop, ImagePair, ImageView, Networks, RangeEstimate, SceneMaps
from flockd.onboard.daemon.worker import Worker

T = TypeVar("T")
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

    def flows(self, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """Raises NetworkStuckError; so do the next two."""
        return self._counted(self._call("flow", self._networks.flows, pairs))

    def scenes(self, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """Depth and drones of each image."""
        return self._counted(self._call("scene", self._networks.scenes, views))

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each crop."""
        try:
            return self._call("ranges", self._networks.ranges, crops)
        except FloatingPointError:
            self.faults += 1
            raise

    def leave(self) -> None:
        """Ends the running call and refuses later ones; returns within a fraction of a second, on any thread."""
        self._left = True
        self._networks.terminate()
        self._worker.leave(TERMINATE_S)

    def _counted(self, results: list[T | Exception]) -> list[T | Exception]:
        self.faults += sum(isinstance(result, FloatingPointError) for result in results)
        return results

    def _call(self, kind: str, function: Callable[..., T], argument: object) -> T:
        if self._left:
            raise NetworkStuckError("the networks have been stopped")
        call = self._worker.submit(function, argument)
        if not self._done_within(call, self._deadline_s):
            self._end(kind, call)
            raise NetworkStuckError(f"a network call took longer than {self._deadline_s:g} s")
        self.stuck = False
        self._abandoned[kind] = 0
        return call.result()

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
