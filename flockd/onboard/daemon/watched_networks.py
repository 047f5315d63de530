"""The networks on their own workers, each call with a deadline: then its run is ended, or else its worker abandoned."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any, TypeVar, cast

from flockd.core.config import DroneConfig
from flockd.core.messages import Float32Array
from flockd.flight.perception import (
    Crops,
    ImagePair,
    ImageView,
    OneByOne,
    RangeEstimates,
    SceneMaps,
    load_networks,
    outcome,
)
from flockd.onboard.worker import Worker

T = TypeVar("T")
TERMINATE_S = 0.5
"""Longest time for a run to end when told to; ONNX Runtime takes a few milliseconds."""
MAX_ABANDONED = 2
"""Calls of one kind in a row with abandoned workers; after them only a restart of the process helps."""


def cameras_at_once(config: DroneConfig) -> int:
    """The number of cameras whose images the networks process in parallel, by `perception.threads`."""
    return min(config.perception.threads, len(config.rig.cameras))


def load_side_by_side(config: DroneConfig) -> WatchedNetworks:
    """The drone's networks as in flight, but without deadlines. Raises ModelError."""
    at_once = cameras_at_once(config)
    return WatchedNetworks(load_networks(config.perception, at_once=at_once), math.inf, at_once)


class NetworkStuckError(Exception):
    """A network call passed its deadline."""


class WatchedNetworks:
    """`Networks` that watch others, on `at_once` images in parallel; called on one thread, counts on any.

    The result for an image does not depend on the parallelism: one worker computes each. Each call has `deadline_s`
    from the start of its worker.
    """

    def __init__(self, networks: OneByOne, deadline_s: float, at_once: int = 1) -> None:
        self.second_stage = networks.second_stage
        self.map_stride = networks.map_stride
        self._networks = networks
        self._deadline_s = deadline_s
        self._workers = [Worker("networks") for _ in range(at_once)]
        self._abandoned: Counter[str] = Counter()
        """Calls with abandoned workers since the last call of that name returned."""
        self._left = False
        self.stuck = False
        """Whether the last call passed its deadline."""
        self.faults = 0
        """Outputs that were not finite, since the start."""
        self.ended = 0
        """Calls that were ended, since the start."""

    @property
    def hopeless(self) -> bool:
        """Whether only a restart of the process helps."""
        return max(self._abandoned.values(), default=0) >= MAX_ABANDONED

    def flows(self, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """Flow of each pair. Raises NetworkStuckError, as the next two do."""
        return self._counted(self._each("flow", self._networks.flow, pairs))

    def scenes(self, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """Depth and drones of each image."""
        return self._counted(self._each("scene", self._networks.scene, views))

    def ranges(self, crops: Crops) -> RangeEstimates:
        """Range and centre of the drone in the middle of each crop; all in one batch."""
        (result,) = self._counted(self._each("ranges", self._networks.ranges, [(crops,)]))
        if isinstance(result, Exception):
            raise result
        return result

    def leave(self) -> None:
        """Ends the running call and refuses later ones; returns within a fraction of a second, on any thread."""
        self._left = True
        self._networks.terminate()
        until_s = time.monotonic() + TERMINATE_S
        for worker in self._workers:
            worker.leave(max(until_s - time.monotonic(), 0.0))

    def _counted(self, results: list[T | Exception]) -> list[T | Exception]:
        self.faults += sum(isinstance(result, FloatingPointError) for result in results)
        return results

    def _each(self, kind: str, function: Callable[..., T], calls: Sequence[tuple[object, ...]]) -> list[T | Exception]:
        """For each call its return value, or the one of `CAMERA_FAULTS` that it raises."""
        results: list[T | Exception | None] = [None] * len(calls)
        left, idle = iter(range(len(calls))), list(self._workers)
        running: dict[Future[Any], tuple[int, Worker, float]] = {}
        while True:
            while idle and not self._left and (k := next(left, None)) is not None:
                worker = idle.pop()
                until_s = time.monotonic() + self._deadline_s
                running[worker.submit(outcome, function, *calls[k])] = k, worker, until_s
            if self._left:
                self._wait_for_end(running)
                raise NetworkStuckError("the networks have been stopped")
            if not running:
                break
            first_s = min(until_s for _, _, until_s in running.values())
            done, _ = wait(running, _timeout(first_s - time.monotonic()), FIRST_COMPLETED)
            if not done:
                self._end(kind, running)
                raise NetworkStuckError(f"a network call took longer than {self._deadline_s:g} s")
            for call in done:
                k, worker, _ = running.pop(call)
                idle.append(worker)
                if call.exception() is not None:
                    self._wait_for_end(running)  # so that no thread is left inside ONNX Runtime
                results[k] = call.result()
        self.stuck = False
        self._abandoned[kind] = 0
        return cast("list[T | Exception]", results)

    def _wait_for_end(self, running: Mapping[Future[Any], object]) -> None:
        wait(running, _timeout(self._deadline_s))

    def _end(self, kind: str, running: Mapping[Future[Any], tuple[int, Worker, float]]) -> None:
        self.stuck = True
        self.ended += 1
        self._networks.terminate()
        _, hung = wait(running, TERMINATE_S)
        self._abandoned[kind] += bool(hung)
        for call in hung:
            _, worker, _ = running[call]
            worker.leave()
            self._workers[self._workers.index(worker)] = Worker("networks")


def _timeout(left_s: float) -> float | None:
    return None if math.isinf(left_s) else max(left_s, 0.0)
