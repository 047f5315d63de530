"""A process for the pilots of some drones: their Python code would otherwise wait for the other drones'.

python -m flockd.sim.pilot_process DESCRIPTOR

It reads its orders from the simulator and answers each, over the socket of that file descriptor. It ends when the
simulator does, however that ends, as nobody holds the other end of the socket then.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from flockd.config.scenario import ScenarioConfig
from flockd.errors import UnavailableError
from flockd.messages import FrameSet, VehicleState
from flockd.sim.pilots import Pilots, Stepped, Swap
from flockd.sim.processes import with_package

if TYPE_CHECKING:
    from flockd.sim.truth_perception import RenderTruth


class PilotProcess:
    """`Pilots` in a process of their own, between ``__enter__`` and ``__exit__``. For one thread at a time.

    Ctrl-C does not reach the process, which has a session of its own.
    """

    def __init__(self, scenario: ScenarioConfig, drones: Sequence[int], swap: Swap | None) -> None:
        """Starts it; it loads the networks while the caller goes on."""
        self._drones = drones
        self._connection, others = Pipe()
        with others:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "flockd.sim.pilot_process", f"{others.fileno()}"],
                env=with_package(os.environ),
                stdin=subprocess.DEVNULL,
                pass_fds=[others.fileno()],
                start_new_session=True,
            )
        self._send(scenario, drones, swap)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()  # it keeps nothing that is not here
        self._process.wait()
        self._connection.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def wait_until_ready(self) -> None:
        """Until its networks are loaded. Raises what loading them did."""
        self._receive()

    def step(
        self, drone: int, frames: FrameSet, vehicle: VehicleState, truth: RenderTruth | None, *, pictured: bool
    ) -> Stepped:
        """See `Pilots.step`. Raises UnavailableError when the process has ended."""
        self._send(drone, frames, vehicle, truth, pictured)
        stepped: Stepped = self._receive()
        return stepped

    def _send(self, *order: object) -> None:
        with suppress(ConnectionError):  # `_receive` says so
            self._connection.send(order)

    def _receive(self) -> Any:
        try:
            answer = self._connection.recv()
        except (EOFError, ConnectionError):
            raise self._ended() from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _ended(self) -> UnavailableError:
        code = self._process.wait()
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        names = ", ".join(f"drone{drone + 1}" for drone in self._drones)
        return UnavailableError(
            f"the process that flew {names} {how}; if nobody ended it, free some memory, and fly again"
        )


def main() -> None:
    """Serves the simulator until it has ended."""
    connection = Connection(int(sys.argv[1]))
    with suppress(EOFError, ConnectionError):
        try:
            pilots = Pilots(*connection.recv())
            connection.send(None)
            while True:
                *order, pictured = connection.recv()
                connection.send(pilots.step(*order, pictured=pictured))
        except (EOFError, ConnectionError):
            raise
        except Exception as error:  # noqa: BLE001 - the simulator raises it again
            error.add_note(traceback.format_exc())
            connection.send(error)


if __name__ == "__main__":
    main()
