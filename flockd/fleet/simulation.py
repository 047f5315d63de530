"""Controls of a live simulation: their messages, and the link to the simulator.

They are no orders to drones: they have a key of the simulator, `flockd-sim/v1/<fleet>/simulator`. The reply to a query
for `.../state` is a `SimulationMessage`. A query for `.../ask/<control>` carries an `AskMessage`, like a drone's; the
reply is an `AnswerMessage`.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, Self, TypedDict

from flockd.fleet.drone_queries import DroneQueries
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.telemetry.topics import AnswerMessage

PREFIX = "flockd-sim/v1"
NAME = "simulator"
CONTROLS = ("pause", "go_on", "restart", "speed", "gusts", "camera", "remove")
"""`speed` has a `factor`, `gusts` a `gust_m_s`, `camera` a `drone`, a `camera` and whether it `works`, `remove` a
`drone`."""
MAX_SPEED, MIN_SPEED, MAX_GUST_M_S = 20.0, 0.05, 3.0
_ASK_EVERY_S = 0.25


class SimulationMessage(TypedDict):
    """The state of a simulation."""

    identity: str
    """Identity in the liveliness tokens of all of its drones."""
    by_sight: bool
    """Whether its drones fly by sight."""
    flight: int
    """Counts up at each restart."""
    time_s: float
    """Of the flight."""
    paused: bool
    speed: float
    """Wanted speed of simulated time."""
    speed_reached: float | None
    """Its speed in the last seconds; null: it stands still, or the speed is not known yet."""
    gust_m_s: float
    cameras_off: dict[str, list[str]]
    """By drone."""
    removed: list[str]
    """Drones."""


def key_of(fleet: str) -> str:
    """Key of a fleet's simulator."""
    return f"{PREFIX}/{fleet}/{NAME}"


def checked_control(control: object, value: object) -> dict[str, object]:
    """The values of a control. Raises ValueError, with a sentence for its sender, for a malformed one."""
    if not isinstance(control, str) or control not in CONTROLS:
        raise ValueError(f"the simulation's controls are {', '.join(CONTROLS)}")
    given = value if isinstance(value, Mapping) else {}
    match control:
        case "speed":
            return {"factor": _number(given, "factor", MIN_SPEED, MAX_SPEED)}
        case "gusts":
            return {"gust_m_s": _number(given, "gust_m_s", 0.0, MAX_GUST_M_S)}
        case "camera":
            works = given.get("works")
            if not isinstance(works, bool):
                raise ValueError("camera needs `works`, true or false")  # noqa: TRY004 - of the message
            return {"drone": _text(given, "drone"), "camera": _text(given, "camera"), "works": works}
        case "remove":
            return {"drone": _text(given, "drone")}
    return {}


def _number(given: Mapping[str, object], key: str, least: float, most: float) -> float:
    value = given.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:  # so NaN
        raise ValueError(f"{key} has to be a number from {least:g} to {most:g}, and is {str(value)[:40]!r}")
    return float(value)


def _text(given: Mapping[str, object], key: str) -> str:
    value = given.get(key)
    if not isinstance(value, str) or len(value) > 200:
        raise ValueError(f"{key} has to be a name")
    return value


class SimulationLink:
    """The link to a fleet's simulator. Queries its state on a thread between ``__enter__`` and ``__exit__``.

    If a drone is heard that is not this simulator's, all controls are refused: a page with real drones has no controls
    of a simulation.
    """

    def __init__(self, fleet: str, watcher: FleetWatcher) -> None:
        """``watcher``: the caller closes it."""
        self._key, self._watcher = f"{fleet}/{NAME}", watcher
        self._queries: DroneQueries = watcher.queries_under(PREFIX)
        self._newest: SimulationMessage | None = None
        self._heard_strangers: set[str] = set()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulation", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def state(self) -> SimulationMessage | None:
        """The newest state; None: no simulator replies, or other drones are heard."""
        newest = self._newest
        return None if newest is None or self._strangers(newest) else newest

    def ask(self, control: str, value: Mapping[str, object], operator: str) -> AnswerMessage:
        """The simulator's answer to a control. Waits: call it on a separate thread."""
        newest = self._newest
        if newest is None:
            return AnswerMessage(accepted=False, sentence="no simulator answers")
        strangers = self._strangers(newest)
        if strangers:
            names = ", ".join(strangers)
            return AnswerMessage(
                accepted=False,
                sentence=f"nothing was sent: {names:.80} is not of this simulation; see who else is here",
            )
        answer = self._queries.ask(self._key, newest["identity"], control, operator, value)
        self._learn()
        return answer or AnswerMessage(accepted=False, sentence="the simulator did not answer")

    def _strangers(self, newest: SimulationMessage) -> list[str]:
        """Drones that were heard with another identity than the simulator's, or without one."""
        own = frozenset({newest["identity"]})
        for one in self._watcher.drones():
            if one.identities - own or not one.announced:
                self._heard_strangers.add(f"{one.fleet}/{one.drone}")
        return sorted(self._heard_strangers)

    def _run(self) -> None:
        while not self._over.wait(_ASK_EVERY_S):
            self._learn()

    def _learn(self) -> None:
        message: Any = self._queries.message(f"{self._key}/state", SimulationMessage)
        self._newest = message
