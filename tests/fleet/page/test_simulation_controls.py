"""Controls of a simulation on the fleet page: who may use them, and that a page of real drones has none."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from aiohttp import WSMsgType

from flockd.fleet.simulation import SimulationLink, SimulationMessage, key_of
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import PREFIX, AboutMessage, AnswerMessage
from flockd.sim.sitl.processes import free_endpoint
from tests.calm import until
from tests.fleet.page.test_access import Client, opened, served

PAUSE = {"control": "pause", "value": None}


def state(identity: str = "i") -> SimulationMessage:
    return SimulationMessage(
        identity=identity, by_sight=False, flight=1, time_s=2.5, paused=False, speed=1.0, speed_reached=None,
        gust_m_s=0.0, cameras_off={}, removed=[],
    )  # fmt: skip


class Simulated:
    """A simulation that notes what is asked of it."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Mapping[str, object], str]] = []

    def state(self) -> SimulationMessage | None:
        return state()

    def ask(self, control: str, value: Mapping[str, object], operator: str) -> AnswerMessage:
        self.asked.append((control, value, operator))
        return AnswerMessage(accepted=True, sentence="done")


async def shown_by(client: Client, headers: Mapping[str, str]) -> object:
    """What the page is told of a simulation."""
    async with client.ws_connect("/live", headers={"Origin": headers["Origin"]}) as socket:
        await socket.send_json({"token": headers["X-Flockd-Token"]})
        async for message in socket:
            assert message.type == WSMsgType.TEXT
            told = message.json()
            if told["kind"] == "rows":
                return told["simulation"]
    raise AssertionError("nothing came")


async def test_a_page_of_drones_that_are_not_simulated_here_shows_no_control_and_sends_none() -> None:
    async with served() as (client, access, _):
        headers = await opened(client, access)
        assert await shown_by(client, headers) is None
        reply = await client.post("/simulate", json=PAUSE, headers=headers)
        assert (reply.status, "not simulated here" in await reply.text()) == (403, True)
        reply = await client.post("/ask", json={"drones": ["f/one"], "command": "pause"}, headers=headers)
        assert reply.status == 400, "a control is no command to a drone"


async def test_controls_need_what_commands_need() -> None:
    simulated = Simulated()
    async with served(simulation=simulated, operator="anna") as (client, access, _):
        assert (await client.post("/simulate", json=PAUSE)).status == 403, "without the key"
        headers = await opened(client, access)
        for wrong in ({"Origin": "http://other"}, {"X-Flockd-Token": "x"}, {"Origin": ""}):
            assert (await client.post("/simulate", json=PAUSE, headers={**headers, **wrong})).status == 403, wrong
        assert simulated.asked == []
        assert await shown_by(client, headers) == {**state()}
        reply = await client.post("/simulate", json=PAUSE, headers=headers)
        assert await reply.json() == {"accepted": True, "sentence": "done"}
        for body in ({"control": "explode"}, {"control": ["pause"]}, {"control": "speed", "value": 2}, ["pause"], None):
            assert (await client.post("/simulate", json=body, headers=headers)).status == 400, body
        ((control, value, operator),) = simulated.asked
        assert (control, value, operator[:11]) == ("pause", {}, "anna, page ")
    async with served(simulation=simulated, may_command=False) as (client, access, _):
        headers = await opened(client, access)
        assert (await client.post("/simulate", json=PAUSE, headers=headers)).status == 403, "--watch-only"
        assert len(simulated.asked) == 1


def test_as_soon_as_a_drone_is_heard_that_is_not_of_the_simulation_there_is_nothing_to_control() -> None:
    """A real drone that connects to the same page, of the same fleet's name: nothing is sent, not after it left."""
    endpoint, drones_at = free_endpoint(), free_endpoint()
    asked: list[str] = []
    about = AboutMessage(version="1", configuration={}, commands=[])

    def nothing(command: str, payload: bytes) -> AnswerMessage:
        return AnswerMessage(accepted=False, sentence="")

    with (
        ZenohTelemetry("f", listen=[endpoint]) as simulator,
        FleetWatcher("f", listen=[drones_at], connect=[endpoint]) as watcher,
    ):

        def reply(last: str, payload: bytes) -> Mapping[str, object]:
            match last:
                case "state":
                    return {**state(simulator.identity)}
                case "time":
                    return {"time_s": 1.0, "wall_s": 1.0, "identity": simulator.identity}
            asked.append(last)
            return {**AnswerMessage(accepted=True, sentence="done")}

        simulator.reply_to(f"{key_of('f')}/**", reply)
        simulator.announce("drone1", about, nothing, lambda camera: None)
        with SimulationLink("f", watcher) as link:
            until(lambda: link.state() is not None and len(watcher.drones()) == 1)
            assert link.ask("pause", {}, "anna") == {"accepted": True, "sentence": "done"}
            with ZenohTelemetry("f", listen=[], connect=[drones_at]) as real:
                real.announce("kite", about, nothing, lambda camera: None)
                until(lambda: link.state() is None)
                refused = link.ask("go_on", {}, "anna")
                assert not refused["accepted"]
                assert "nothing was sent: f/kite is not of this simulation" in refused["sentence"]
            until(lambda: not any(one.alive for one in watcher.drones() if one.drone == "kite"))
            assert link.state() is None
            assert asked == ["pause"]


def test_the_simulators_key_is_none_of_a_drones() -> None:
    assert not key_of("f").startswith(f"{PREFIX.split('/')[0]}/")
    with ZenohTelemetry("f", listen=[free_endpoint()]) as simulator, pytest.raises(ValueError, match="is a drone's"):
        simulator.reply_to(f"{PREFIX}/f/drone1/ask/*", lambda last, payload: {})
