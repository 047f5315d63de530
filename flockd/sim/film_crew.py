"""Shows the daemons of a simulated fleet what their cameras see, again and again, and keeps where everybody was."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from flockd.config.scenario import ScenarioConfig
from flockd.sim.ground_station import Poses
from flockd.sim.photographer import Photographer
from flockd.sources import FramePublisher


@dataclass(frozen=True, eq=False)
class Shooting:
    """One frame set of each drone, all taken at once."""

    time_s: float
    """On the simulated clock: the time stamp of all its frames."""
    poses: Poses
    """Of the whole flock then."""
    took_s: float
    """Simulated seconds until the last drone had its frames."""


class FilmCrew:
    """Takes and publishes frames on a thread of its own between ``__enter__`` and ``__exit__``."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        drones: Sequence[str],
        *,
        endpoint: str,
        rate_hz: float,
        poses: Callable[[], Poses],
        clock: Callable[[], float],
        speed_factor: float,
    ) -> None:
        """Makes the world, which takes seconds. ``drones`` are names in the order of ``poses``.

        Raises UnavailableError for an endpoint that cannot be used.
        """
        self._photographer = Photographer(scenario)
        self._publisher = FramePublisher(listen=[endpoint])
        self._drones, self._period_s = tuple(drones), 1.0 / rate_hz
        self._poses, self._clock, self._speed_factor = poses, clock, speed_factor
        self._shootings: list[Shooting] = []
        self._failure: BaseException | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="film crew", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._publisher.close()

    def start(self) -> None:
        """Begins to take pictures."""
        self._thread.start()

    def shootings(self) -> tuple[Shooting, ...]:
        """All so far. Raises what ended the work."""
        if self._failure is not None:
            raise self._failure
        return tuple(self._shootings)

    def notes(self) -> tuple[str, ...]:
        """What a person should know although nothing is wrong."""
        return self._publisher.notes()

    def _run(self) -> None:
        due_s = self._clock()
        try:
            while not self._closing.wait(max(0.0, due_s - self._clock()) / self._speed_factor):
                self._shoot(len(self._shootings))
                due_s = max(due_s + self._period_s, self._clock())
        except BaseException as error:  # noqa: BLE001 - `shootings` raises it where somebody can do something
            self._failure = error

    def _shoot(self, number: int) -> None:
        poses, time_s = self._poses(), self._clock()
        for i, drone in enumerate(self._drones):
            frames, _ = self._photographer.photograph(i, number, time_s, poses)
            for frame in frames.frames.values():
                self._publisher.publish(drone, frame)
        self._shootings.append(Shooting(time_s, poses, self._clock() - time_s))
