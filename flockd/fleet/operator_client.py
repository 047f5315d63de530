"""Asks drones of a fleet over telemetry what operators may ask: for the commands of people. Nothing that flies does."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from flockd.fleet.drone_queries import DroneQueries
from flockd.onboard.telemetry.topics import PREFIX, AnswerMessage, checked_name
from flockd.onboard.telemetry.zenoh_session import SessionOwner, open_session

FIND_S = 3.0
_AGAIN_S = 0.2


class FleetOperator(SessionOwner):
    """Sends commands to the drones of a fleet. Raises UnavailableError for an endpoint that cannot be used."""

    def __init__(
        self, fleet: str | None, *, listen: Sequence[str], connect: Sequence[str], settings: Path | None = None
    ) -> None:
        """``fleet``: None for every fleet that is heard."""
        self._fleet = "*" if fleet is None else checked_name(fleet)
        self._session = open_session("telemetry", listen, connect, settings=settings)
        self._queries = DroneQueries(self._session)

    def drones(self, wanted: Sequence[str] | None, find_s: float = FIND_S) -> tuple[str, ...]:
        """The keys `fleet/drone` of the drones that are alive, in order; ``wanted``: of these names, None: of all.

        Waits up to ``find_s`` seconds: until all that are wanted are found, or for all to be heard.
        """
        until_s = time.monotonic() + find_s
        while True:
            replies = self._session.liveliness().get(f"{PREFIX}/{self._fleet}/*/alive", timeout=_AGAIN_S)
            keys = {"/".join(str(reply.ok.key_expr).split("/")[2:4]) for reply in replies if reply.ok is not None}
            found = {key for key in keys if wanted is None or key.split("/")[1] in wanted}
            complete = wanted is not None and {key.split("/")[1] for key in found} >= set(wanted)
            if complete or time.monotonic() >= until_s:
                return tuple(sorted(found))
            time.sleep(_AGAIN_S)

    def ask(self, drone: str, command: str, message: Mapping[str, object] | None = None) -> AnswerMessage | None:
        """One drone's answer to a command; ``drone`` as of `drones`. None: it gave none in time."""
        return self._queries.ask(drone, command, message)
