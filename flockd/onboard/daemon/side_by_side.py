"""The networks on several cameras at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import wait
from typing import Protocol, TypeVar, cast

from flockd.core.config import DroneConfig
from flockd.core.messages import Float32Array
from flockd.flight.inference.checks import Deadline, no_deadline
from flockd.flight.perception import (
    Crop,
    ImageNetworks,
    ImagePair,
    ImageView,
    RangeEstimate,
    SceneMaps,
    load_networks,
    outcome,
)
from flockd.onboard.daemon.watched_networks import InterruptibleNetworks
from flockd.onboard.daemon.worker import Worker

T = TypeVar("T")
BACKLOG = 8
"""Calls that may wait behind one that hangs; the daemon starts anew after two."""


class InterruptibleImageNetworks(ImageNetworks, Protocol):
    """Networks whose runs can be ended."""

    def terminate(self) -> None:
        """Ends every call under way, from any thread."""


def load_side_by_side(config: DroneConfig, deadline: Deadline = no_deadline) -> InterruptibleNetworks:
    """The drone's networks, on as many of its cameras at once as `perception.threads` allows. Raises ModelError."""
    at_once = min(config.perception.threads, len(config.rig.cameras))
    networks = load_networks(config.perception, deadline, at_once=at_once)
    return networks if at_once == 1 else SideBySide(networks, at_once)


class SideBySide:
    """`Networks` that answer for so many images `at_once`, each on a thread of its own; one thread calls them.

    What an image gives does not depend on how many are computed at once: each is computed by one thread.
    """

    def __init__(self, networks: InterruptibleImageNetworks, at_once: int) -> None:
        self.second_stage = networks.second_stage
        self.map_stride = networks.map_stride
        self._networks = networks
        self._workers = [Worker(f"networks {k}", BACKLOG) for k in range(at_once)]

    def flows(self, pairs: Sequence[ImagePair]) -> list[Float32Array | Exception]:
        """See `Networks`."""
        return self._each(self._networks.flow, pairs)

    def scenes(self, views: Sequence[ImageView]) -> list[SceneMaps | Exception]:
        """See `Networks`."""
        return self._each(self._networks.scene, views)

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """See `Networks`; in one batch, on the caller's thread."""
        return self._networks.ranges(crops)

    def terminate(self) -> None:
        """Ends every call under way, from any thread."""
        self._networks.terminate()

    def _each(self, function: Callable[..., T], images: Sequence[tuple[object, ...]]) -> list[T | Exception]:
        results: list[T | Exception | None] = [None] * len(images)
        left = iter(range(len(images)))

        def some() -> None:
            for k in left:
                results[k] = outcome(function, *images[k])

        calls = [worker.submit(some) for worker in self._workers]
        wait(calls)  # none is left inside ONNX Runtime where one has failed
        for call in calls:
            call.result()
        return cast("list[T | Exception]", results)
