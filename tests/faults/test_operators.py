"""Hostile peers, drones that never answer, two of one name, and orders without end, beside a drone that flies."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from flockd.core.config import DroneConfig
from flockd.fleet.drone_rows import status_rows
from flockd.fleet.live_fleet import LiveFleet
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.telemetry.zenoh_session import close_session, open_session
from flockd.sim.sitl.ports import free_endpoint
from tests.faults.process import Process, flying
from tests.faults.stories import Reacted
from tests.fleet.page.test_access import opened, served
from tests.make import changed
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL
from tests.onboard.telemetry.test_malformed import FLIGHT

pytestmark = pytest.mark.slow
ABSURD: dict[str, dict[str, Any]] = {
    "state": {
        "time_s": 1.0, "height_m": 1.5e308, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 0.0,
        "velocity_ned": [1.5e308] * 3, "position_ne": [1.5e308] * 2, "home_deg": [1e308, 1e308],
    },
    "events": {"time_s": 1.0, "event": "x" * 1_000_000},
}  # fmt: skip
"""Of a drone that is there; beside it, names by the thousand."""
SILENT, CAMERAS = 2, 12


def connecting(endpoint: str) -> Any:
    """The drone connects to who watches, as strangers may."""

    def change(config: DroneConfig) -> DroneConfig:
        return changed(config, telemetry__connect=(endpoint,))

    return change


@contextmanager
def silent_drones(session: zenoh.Session) -> Iterator[None]:
    """Drones that say what they fly with, and answer nothing else for as long as this lasts."""
    over = threading.Event()
    kept: list[Any] = []
    about = json.dumps({"version": "1", "configuration": {}, "commands": ["land"]})
    for number in range(SILENT):
        key = f"flockd/v1/test/silent{number}"
        kept += [
            session.liveliness().declare_token(f"{key}/alive/{number}"),
            session.declare_queryable(f"{key}/about", lambda query: query.reply(query.key_expr, about)),
            session.declare_queryable(f"{key}/image/*", lambda query: over.wait()),
        ]
    try:
        yield
    finally:
        over.set()
        for one in kept:
            one.undeclare()


@pytest.mark.fault("hostile-peers", within_s=60.0)
@pytest.mark.fault("stuck-pictures", within_s=1.0)
async def test_neither_absurd_peers_nor_stuck_pictures_keep_an_order_from_a_drone(
    tmp_path: Path, reacted: Reacted
) -> None:
    endpoint = free_endpoint()
    async with flying(tmp_path, change=connecting(endpoint)) as process:
        with (
            FleetWatcher("test", listen=[endpoint], connect=[]) as watcher,
            LiveFleet(watcher) as fleet,
        ):
            hostile, silent = open_session("hostile", [], [endpoint]), open_session("silent", [], [endpoint])
            tokens = [hostile.liveliness().declare_token("flockd/v1/test/absurd/alive/0")]
            await until(lambda: "test/tiny" in fleet.rows(fleet.now_s()), SECONDS_TO_FAIL)
            for number in range(10_000):
                hostile.put(f"flockd/v1/test/invented{number}/flight", json.dumps(FLIGHT if number % 2 else {}))
                for topic in ABSURD if number % 500 == 0 else ():
                    hostile.put(f"flockd/v1/test/absurd/{topic}", json.dumps(ABSURD[topic]))
                await asyncio.sleep(0.0)
            began_s = time.monotonic()
            await until(lambda: watcher.malformed + watcher.forgotten > 5000, SECONDS_TO_FAIL)
            rows = fleet.rows(fleet.now_s())
            json.dumps([rows, fleet.history(), fleet.events()], allow_nan=False)
            assert rows["test/tiny"]["state"] in {"normal", "degraded"}
            assert rows["test/absurd"]["speed_m_s"] is None
            assert list(rows).index("test/tiny") < 3, "invented names stand last"
            reacted("hostile-peers", time.monotonic() - began_s)
            with silent_drones(silent):
                async with served(fleet=fleet) as (client, access, _):
                    own = await opened(client, access)
                    await until(lambda: fleet.rows(fleet.now_s())["test/tiny"]["commands"] is not None, SECONDS_TO_FAIL)
                    pictures = [
                        asyncio.create_task(client.get(f"/image/test/silent{drone}/camera{camera}"))
                        for _ in range(4)
                        for drone in range(SILENT)
                        for camera in range(CAMERAS)
                    ]
                    await asyncio.sleep(0.5)
                    began_s = time.monotonic()
                    order = {"drones": ["test/tiny"], "command": "land"}
                    answer = await (await client.post("/ask", json=order, headers=own)).json()
                    assert answer["test/tiny"]["accepted"], answer
                    reacted("stuck-pictures", time.monotonic() - began_s)
                    assert {(await picture).status for picture in pictures} == {204}
            await until(lambda: process.fake_autopilot.mode == "LAND", SECONDS_TO_FAIL)
            del tokens
            close_session(hostile)
            close_session(silent)


async def _answer(process: Process, command: str, **ask: object) -> dict[str, Any]:
    """To an order as it is, or to one that is right but for what is given."""
    clock = await process.ask("time")
    known = {"identity": clock["identity"], "operator": "anna", "session": "a", "sequence": 1, "order": None}
    payload = json.dumps({**known, "time_s": clock["time_s"], **ask}).encode()
    answer: dict[str, Any] = json.loads(await process._query(f"ask/{command}", payload))
    return answer


@pytest.mark.fault("one-name-twice", within_s=5.0)
@pytest.mark.fault("order-replayed", within_s=3.0)
@pytest.mark.fault("orders-without-end", within_s=3.0)
async def test_orders_that_are_old_or_ambiguous_or_without_end(tmp_path: Path, reacted: Reacted) -> None:
    async with flying(tmp_path) as process:
        # Two drones of one name.
        (drone,) = process.watcher.drones()
        key = f"{drone.fleet}/{drone.drone}"
        impostor = open_session("impostor", [free := free_endpoint()], [])
        with FleetWatcher("test", listen=[], connect=[process.config.telemetry.listen[0], free]) as both:
            await until(lambda: bool(both.drones()), SECONDS_TO_FAIL)
            began_s = time.monotonic()
            other = impostor.liveliness().declare_token("flockd/v1/test/tiny/alive/another")
            await until(lambda: any(len(one.identities) == 2 for one in both.drones()), SECONDS_TO_FAIL)
            reacted("one-name-twice", time.monotonic() - began_s)
            (row,) = status_rows(both.drones(), time.monotonic())
            assert "2 drones call themselves tiny" in row["matters"][0]
            refused = await asyncio.to_thread(both.ask, key, "land", "anna")
            assert refused is not None and not refused["accepted"]
            assert process.fake_autopilot.mode == "OFFBOARD"
            other.undeclare()  # type: ignore[no-untyped-call]
            await until(lambda: all(len(one.identities) == 1 for one in both.drones()), SECONDS_TO_FAIL)
        close_session(impostor)

        # Replayed, late, of another operator.
        clock = await process.ask("time")
        assert (await _answer(process, "resume"))["accepted"]
        assert "has come before" in (await _answer(process, "land"))["sentence"]
        assert "give it again" in (await _answer(process, "land", sequence=2, time_s=clock["time_s"] - 60))["sentence"]
        assert "another drone" in (await _answer(process, "land", sequence=3, identity="another"))["sentence"]
        began_s = time.monotonic()
        assert (await _answer(process, "resume", operator="bert", session="b"))["accepted"]
        await until(
            lambda: [one["operator"] for one in process.heard()["flight"].message["orders"]][:2] == ["bert", "anna"],
            SECONDS_TO_FAIL,
        )
        reacted("order-replayed", time.monotonic() - began_s)
        await process.until_event("an operator asked for resume: bert, order 1")
        assert process.fake_autopilot.mode == "OFFBOARD"

        # Refused, again and again.
        lost, refusals = process.heard()["computer"].message["messages_lost"], 5000
        for _ in range(refusals):
            for _ in process.session.get("flockd/v1/test/tiny/ask/hold", payload=b"{", timeout=3.0):
                pass
            await asyncio.sleep(0.0)
        began_s = time.monotonic()
        assert (await _answer(process, "land", sequence=9))["accepted"]
        reacted("orders-without-end", time.monotonic() - began_s)
        await until(lambda: process.fake_autopilot.mode == "LAND", SECONDS_TO_FAIL)
        await until(lambda: process.heard()["flight"].message["orders_refused"] >= refusals, SECONDS_TO_FAIL)
        assert process.heard()["computer"].message["messages_lost"] == lost
        assert len(process.log()) < 100_000
        assert sum("was refused" in event for event in process.events) < 50
