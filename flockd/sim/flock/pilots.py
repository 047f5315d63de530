"""The pilots of a simulated flock that see: on the calling thread, or in processes of their own.

On threads of one process they wait for Python's lock: a step of five drones on two cores takes a twentieth longer.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterable, Mapping
from multiprocessing.connection import Connection, Pipe
from subprocess import DEVNULL, Popen
from traceback import format_exc
from typing import Any, NamedTuple, Protocol

from flockd.core.config import DroneConfig
from flockd.core.config.perception import PerceptionConfig
from flockd.core.errors import FlockdError
from flockd.core.messages import FrameSet, MissionOrder, PilotOutput, VehicleState
from flockd.flight.perception import Networks, load_networks
from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.review.flight_log.key_frames import KeyFrame, capture

_NICER = 5
_ENVIRONMENT = {
    "MALLOC_TRIM_THRESHOLD_": str(2**28),  # the C library gives no memory of images back, only to get it again
    "MALLOC_MMAP_THRESHOLD_": str(2**26),
    "OPENBLAS_NUM_THREADS": "1",  # see `flockd.program`
    "MKL_NUM_THREADS": "1",
}
"""Of the processes, where it does not say otherwise."""
Stepped = tuple[PilotOutput, list[KeyFrame]]


class PilotStep(NamedTuple):
    """What a pilot gets in one step."""

    drone: int
    frames: FrameSet
    vehicle: VehicleState
    pictured: bool
    """Whether its key frames are wanted."""
    order: MissionOrder | None


class Pilots(Protocol):
    """One pilot a drone. They share nothing that a flight changes, so that their order does not matter."""

    def begin(self, configs: Mapping[int, DroneConfig]) -> None:
        """New pilots, for a flight from the beginning."""

    def step(self, steps: Iterable[PilotStep]) -> dict[int, Stepped]:
        """What each drone's pilot puts out, and its key frames at half size."""


class PilotsHere:
    """On the calling thread, one after the other."""

    def __init__(self, networks: Networks) -> None:
        self._networks, self._pilots = networks, dict[int, FlockPilot]()

    def begin(self, configs: Mapping[int, DroneConfig]) -> None:
        """See `Pilots`."""
        self._pilots = {
            i: FlockPilot(config, self._networks, stopwatch=time.perf_counter) for i, config in configs.items()
        }

    def step(self, steps: Iterable[PilotStep]) -> dict[int, Stepped]:
        """See `Pilots`."""
        return {one.drone: self.stepped(one) for one in steps}

    def stepped(self, one: PilotStep) -> Stepped:
        """Of one pilot."""
        trace = StepTrace() if one.pictured else None
        output = self._pilots[one.drone].step(one.frames, one.vehicle, trace, one.order)
        seen = [] if trace is None else capture(trace, output, one.drone)
        return output, [frame.at_half_size() for frame in seen]


class PilotProcesses:
    """In processes, which end with this object or with the process that holds it, however that ends."""

    def __init__(self, perception: PerceptionConfig, drones: int) -> None:
        """Raises ModelError. There are more processes than processors, so that all end a step together."""
        self._connections = list[Connection]()
        self.processes = list[Popen[bytes]]()
        # They inherit the mask, so that Ctrl-C is this process's alone.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for _ in range(min(drones, 1 + 2 * (os.cpu_count() or 1))):
                here, there = Pipe()
                command = [sys.executable, "-c", f"from {__name__} import serve; serve({there.fileno()})"]
                environment = _ENVIRONMENT | os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
                self.processes.append(Popen(command, pass_fds=[there.fileno()], stdin=DEVNULL, env=environment))
                there.close()
                self._connections.append(here)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for connection in self._connections:
            _send(connection, perception)
        for connection in self._connections:
            _received(connection)

    def begin(self, configs: Mapping[int, DroneConfig]) -> None:
        """See `Pilots`."""
        for k, connection in enumerate(self._connections):
            _send(connection, {i: one for i, one in configs.items() if i % len(self._connections) == k})
            _received(connection)

    def step(self, steps: Iterable[PilotStep]) -> dict[int, Stepped]:
        """See `Pilots`. A pilot begins once its step comes. Raises FlockdError if a process ended."""
        busy, found = dict[Connection, int](), dict[int, Stepped]()
        for one in steps:
            connection = self._connections[one.drone % len(self._connections)]
            if connection in busy:
                found[busy[connection]] = _received(connection)
            _send(connection, one)
            busy[connection] = one.drone
        return found | {drone: _received(connection) for connection, drone in busy.items()}


class _GoneError(FlockdError):
    """The other side of a connection ended."""

    def __init__(self) -> None:
        super().__init__("a process with pilots ended; watch the memory, or fly fewer drones")


def _send(connection: Connection, what: object) -> None:
    try:
        connection.send(what)
    except OSError:
        raise _GoneError from None


def _received(connection: Connection) -> Any:
    """Raises what the other side sent, if that is an exception."""
    try:
        what = connection.recv()
    except (EOFError, OSError):
        raise _GoneError from None
    if isinstance(what, Exception):
        raise what
    return what


def serve(descriptor: int) -> None:
    """Answers on a connection until the other side is gone. Images are drawn first: pilots wait for them."""
    os.nice(_NICER)
    connection = Connection(descriptor)
    try:
        pilots = PilotsHere(load_networks(_received(connection)))
        _send(connection, None)
        while True:
            asked = _received(connection)
            if isinstance(asked, PilotStep):
                _send(connection, pilots.stepped(asked))
            else:
                pilots.begin(asked)
                _send(connection, None)
    except _GoneError:
        return
    except Exception as error:  # noqa: BLE001 - the other side raises it
        error.add_note(format_exc())  # a traceback does not travel
        _send(connection, error)
