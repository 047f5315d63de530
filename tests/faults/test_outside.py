"""Faults that come over the network, while a whole drone flies or is watched."""

from __future__ import annotations

import asyncio
import itertools
import json
from typing import Any

import pytest
import zenoh

from flockd.sim.sitl.processes import free_endpoint
from tests.calm import clock
from tests.faults.conftest import InTheAir, never_alone
from tests.make import changed
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL, Aboard, client

pytestmark = pytest.mark.slow


async def _flies_on(ship: Aboard) -> None:
    await ship.steps_on()
    assert ship.fake_autopilot.mode == "OFFBOARD", "; ".join(ship.events)
    assert not ship.ending.done()


def _router(endpoint: str) -> tuple[Any, list[str]]:
    """What a drone connects to, and the keys of what it hears."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    session = zenoh.open(config)
    keys: list[str] = []
    session.declare_subscriber("flockd/v1/**", lambda sample: keys.append(str(sample.key_expr)))
    return session, keys


@pytest.mark.fault("telemetry-router-gone")
async def test_the_router_of_the_telemetry_goes_and_comes_back(in_flight: InTheAir) -> None:
    endpoint = free_endpoint()
    router, keys = _router(endpoint)
    async with in_flight(lambda config: changed(never_alone(config), telemetry__connect=(endpoint,))) as ship:
        await until(lambda: "flockd/v1/test/tiny/flight" in keys, SECONDS_TO_FAIL)
        gone_s = clock()
        router.close()
        await _flies_on(ship)
        sent = [at_s for at_s, _ in list(ship.fake_autopilot.setpoints) if at_s > gone_s]
        gaps = [after - before for before, after in itertools.pairwise(sent)]
        assert max(gaps) < 0.5, "PX4 wants two setpoints a second"
        router, keys = await asyncio.to_thread(_router, endpoint)
        await until(lambda: "flockd/v1/test/tiny/flight" in keys, 60.0)
        router.close()


@pytest.mark.fault("malformed-telemetry")
async def test_nonsense_on_the_telemetry_bus(in_flight: InTheAir) -> None:
    """The drone reads nothing but questions; `hold` is not among `telemetry.commands` of this one."""
    async with in_flight() as ship:
        # In threads: the drone flies on this event loop, and a session takes its time.
        session = await asyncio.to_thread(zenoh.open, client(ship.config.telemetry.listen[0]))
        key = "flockd/v1/test/tiny"
        for payload in (b"\xff\x00", b"[" * 10_000, b"", json.dumps({"time_s": "now"}).encode()):
            for topic in ("state", "flight", "ask/hold", "ask/land", "about", "alive", "image/front", "x/y/z"):
                await asyncio.to_thread(session.put, f"{key}/{topic}", payload)
        for question in ("ask/hold", "ask/HOLD", "ask/land/now", "ask/*", "image/none", "image/" + "x" * 500):
            await asyncio.to_thread(_asked, session, f"{key}/{question}")
        assert (await ship.ask("ask/hold"))["accepted"] is False
        await _flies_on(ship)
        assert not any("asked for land" in event for event in ship.events)
        await asyncio.to_thread(session.close)


def _asked(session: zenoh.Session, question: str) -> None:
    list(session.get(question, payload=b"\xff" * 1000, timeout=1.0))
