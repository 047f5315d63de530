"""Several cameras' images at once: the same answers in the same order, and none is left running."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from flockd.core.messages import Float32Array, Frame, UInt8Array
from flockd.flight.perception import ImagePair
from flockd.onboard.daemon.watched_networks import WatchedNetworks
from tests.onboard.daemon.aboard import TinyPerceiver

TOGETHER_S = 20.0


def pair(k: int) -> ImagePair:
    image = np.full((48, 64, 3), k, np.uint8)
    frame = Frame(f"camera {k}", image, 0.0, k)
    return ImagePair(frame, frame, np.zeros((48, 64), np.uint8))


class Pictures(TinyPerceiver):
    """A flow is of its image's value; or what `instead` has for its number happens first."""

    def __init__(self) -> None:
        super().__init__()
        self.instead: dict[int, Callable[[], object]] = {}
        self.done: list[int] = []

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        self.instead.get(first.sequence, lambda: None)()
        self.done.append(first.sequence)
        return np.full((48, 64, 2), float(first.image[0, 0, 0]), np.float32)


def fault(error: Exception) -> Callable[[], None]:
    def raised() -> None:
        raise error

    return raised


def test_images_are_computed_at_once_and_come_back_in_order() -> None:
    networks, together = Pictures(), threading.Barrier(3)
    networks.instead = dict.fromkeys(range(6), lambda: together.wait(TOGETHER_S))
    flows = WatchedNetworks(networks, TOGETHER_S, 3).flows([pair(k) for k in range(6)])
    assert [float(flow[0, 0, 0]) for flow in flows if isinstance(flow, np.ndarray)] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_the_fault_of_one_image_is_its_own() -> None:
    networks = Pictures()
    networks.instead = {0: fault(ValueError("too small")), 2: fault(FloatingPointError("not finite"))}
    flows = WatchedNetworks(networks, TOGETHER_S, 2).flows([pair(k) for k in range(4)])
    assert [type(flow) for flow in flows] == [ValueError, np.ndarray, FloatingPointError, np.ndarray]


def test_an_error_that_nobody_expects_comes_when_what_runs_beside_it_has_ended() -> None:
    networks, failed = Pictures(), threading.Event()

    def fails() -> None:
        failed.set()
        raise KeyError("for the test")

    networks.instead = {0: fails, 1: lambda: failed.wait(TOGETHER_S)}
    with pytest.raises(KeyError):
        WatchedNetworks(networks, TOGETHER_S, 2).flows([pair(k) for k in range(5)])
    assert networks.done[0] == 1


def test_each_image_has_the_deadline_for_itself() -> None:
    networks = Pictures()
    networks.instead = dict.fromkeys(range(6), lambda: time.sleep(0.25))
    assert len(WatchedNetworks(networks, 1.4, 1).flows([pair(k) for k in range(6)])) == 6
