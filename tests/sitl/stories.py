"""Stories that are flown with the fake autopilot or with PX4 SITL, and what flockd sees: messages, order, seconds.

A relay between autopilot and flockd loses what a story wants lost. `pytest -rP` prints the rows.
"""

from __future__ import annotations

import asyncio
import os
import socket
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.safety import SafetyParameters
from flockd.core.errors import UnavailableError
from flockd.core.messages import FloatArray, Setpoint, Wanted
from flockd.flight.safety import Action, Permission, Request, Verdict
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink, Severity
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.sim.sitl.autopilots import Autopilots, Px4s, SimulatedAutopilots
from flockd.sim.sitl.processes import free_port
from tests.make import around
from tests.onboard.autopilot.pilots_link import PilotsLink
from tests.sitl.sitl_run import Meddler, one_drone

HEIGHT_M = 4.0
NORTH_M_S = 1.0
START_S = 60.0
STEP_S, POLL_S = 30.0, 0.01
GROUND_STATION_PORT = 14550
"""Where PX4's instance 0 looks for one."""
TEXT = "flockd hover: no camera has sent a usable frame for 1.2 s; 2 more reasons"
HEARTBEAT, EVENT = 0, 410


@dataclass(frozen=True)
class Row:
    """One thing that flockd saw."""

    story: str
    what: str
    after_s: float | None = None
    """Since what provoked it; None where time does not matter."""


class Relay:
    """Passes on packets between an autopilot and flockd, both ways, but for those that a story wants lost."""

    def __init__(self, autopilot_port: int, flockd_port: int) -> None:
        self.losing: Callable[[int], bool] = lambda number: False
        """Whether to lose a packet from the autopilot, by the number of its message."""
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind(("127.0.0.1", autopilot_port))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.bind(("127.0.0.1", 0))
        self._flockd = ("127.0.0.1", flockd_port)
        self._autopilot = ("", 0)
        self._closing = threading.Event()
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._inward, self._outward)]

    def __enter__(self) -> Relay:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        for one in (self._near, self._far):
            one.close()

    def _inward(self) -> None:
        while not self._closing.is_set():
            try:
                data, self._autopilot = self._near.recvfrom(65536)
                kept = b"".join(packet for number, packet in _packets(data) if not self.losing(number))
                if kept:
                    self._far.sendto(kept, self._flockd)
            except OSError:
                return

    def _outward(self) -> None:
        while not self._closing.is_set():
            try:
                data, _ = self._far.recvfrom(65536)
                if self._autopilot[1]:
                    self._near.sendto(data, self._autopilot)
            except OSError:
                return


def _packets(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The MAVLink 2 packets of a datagram, with the numbers of their messages."""
    while len(data) >= 12 and data[0] == 0xFD:
        length = 12 + data[1] + (13 if data[2] & 1 else 0)
        yield int.from_bytes(data[7:10], "little"), data[:length]
        data = data[length:]


@dataclass
class World:
    """One autopilot, and flockd's link to it."""

    link: PilotsLink
    streamer: SetpointStreamer
    station: Meddler
    relay: Relay
    restart: Callable[[], None]
    clock: Callable[[], float]
    rows: list[Row] = field(default_factory=list)
    reports: list[str] = field(default_factory=list)
    """All that the link has reported."""

    async def until(self, condition: Callable[[], bool], what: str, timeout_s: float = STEP_S) -> float:
        """Seconds until it holds. Raises UnavailableError when it does not in time."""
        begun = self.clock()
        while not condition():
            if self.clock() - begun > timeout_s:
                raise UnavailableError(f"{what} did not come within {timeout_s:g} s")
            await asyncio.sleep(POLL_S)
            self.reports += self.link.take_reports()
        return self.clock() - begun

    async def saw(self, story: str, condition: Callable[[], bool], what: str) -> None:
        """Adds a row once the condition holds, or one that says that it never did."""
        try:
            self.rows.append(Row(story, what, round(await self.until(condition, what), 2)))
        except UnavailableError:
            self.rows.append(Row(story, f"never: {what}"))

    def texts(self) -> list[str]:
        """What the autopilot has said since the last call."""
        self.reports += self.link.take_reports()
        texts = [report.removeprefix("the autopilot says: ") for report in self.reports if "says: " in report]
        self.reports.clear()
        return texts

    async def asked(self, story: str, ask: Callable[[], Awaitable[None]]) -> None:
        """Adds a row with the answer to a request."""
        try:
            await ask()
            self.rows.append(Row(story, "accepted"))
        except AutopilotError as error:
            self.rows.append(Row(story, str(error).partition(", which was ")[2] or str(error)))

    def mode(self, mode: str) -> Callable[[], bool]:
        """The link shows this mode."""
        return lambda: self.link.status().flight_mode == mode

    async def offboard(self) -> None:
        """Streams, and flies."""
        self.streamer.begin()
        await asyncio.sleep(0.5)
        await self.link.request_offboard()
        await self.until(self.mode("offboard"), "offboard")

    async def hold(self) -> None:
        """Ends the stream, and stands."""
        self.streamer.end("by the story")
        await self.link.hold()
        await self.until(lambda: not self.link.status().failsafe and self.mode("hold")(), "Hold")


async def on_the_ground(world: World) -> None:
    """Before the flight."""
    link = world.link
    await world.saw("start: checks told", lambda: link.knows_checks() and not link.refusals(), "nothing against arming")
    await world.saw("start: announced", link.announces, "flockd announces itself, so that texts come")
    await asyncio.sleep(2.0)  # the announcement is heard
    world.station.select(0, "LAND")
    await world.until(world.mode("land"), "Land")
    refused = lambda: any(refusal.refused == "to arm" for refusal in link.refusals())  # noqa: E731
    await world.saw("arm in Land mode", refused, "the refusal is shown before it is asked")
    await world.asked("arm in Land mode", link.arm)
    world.texts()
    world.station.select(0, "LOITER")
    await world.until(world.mode("hold"), "Hold")
    losing = iter([True, True])
    world.relay.losing = lambda number: number == EVENT and next(losing, False)
    world.streamer.begin()
    await world.saw("two events lost", lambda: offboard_possible(link), "the list is asked for anew, and whole")
    world.relay.losing = lambda number: False
    world.streamer.end("by the story")


def offboard_possible(link: AutopilotLink) -> bool:
    """The list of checks lets offboard be selected."""
    report = link.received.check_events.report
    return report is not None and bool(report.can_run >> 14 & 1)


async def take_off(world: World) -> None:
    """Until it hovers."""
    await world.asked("arm", world.link.arm)
    await world.asked("take off", world.link.take_off)
    await world.saw("take off", lambda: world.link.status().in_air, "in the air")
    await world.until(lambda: _height_m(world) > HEIGHT_M - 0.5 and world.mode("hold")(), "the height", 60.0)


def _height_m(world: World) -> float:
    state = world.link.vehicle_state()
    return 0.0 if state is None else state.height_m


async def in_flight(world: World) -> None:
    """Offboard, and what ends it."""
    link, streamer, station = world.link, world.streamer, world.station
    world.texts()
    await world.asked("offboard without setpoints", link.request_offboard)
    world.streamer.begin()
    await asyncio.sleep(0.5)
    await world.asked("offboard", link.request_offboard)
    await world.saw("offboard", world.mode("offboard"), "the mode is offboard")
    await asyncio.sleep(2.5)
    world.rows.append(Row("offboard", f"foreign setpoints: {link.status().foreign_setpoints}"))
    await _lose_heartbeats(world)
    world.texts()
    streamer.end("by the story")
    await world.saw("setpoints stop", world.mode("hold"), "the mode is hold")
    await world.saw("setpoints stop", lambda: link.status().failsafe, "it is in its failsafe")
    await asyncio.sleep(1.0)
    world.rows.append(Row("setpoints stop", f"said: {'; '.join(world.texts()) or 'nothing'}"))
    await _setpoints_come_back(world)
    streamer.end("by the story")
    await world.until(world.mode("hold"), "Hold")
    await asyncio.sleep(1.5)
    station.select(0, "LOITER")
    await world.saw("Hold selected in the failsafe", lambda: not link.status().failsafe, "the failsafe is over")
    await world.asked("Acro in the air", lambda: link._command("for acro", 176, 1, 5, 0, refused="acro"))
    world.texts()
    station.select(0, "ACRO")
    await asyncio.sleep(1.0)
    world.rows.append(Row("Acro for a station", f"said: {'; '.join(world.texts()) or 'nothing'}"))
    await world.hold()


async def _lose_heartbeats(world: World) -> None:
    """Every third, for twelve seconds."""
    count = [0]

    def every_third(number: int) -> bool:
        count[0] += number == HEARTBEAT
        return number == HEARTBEAT and count[0] % 3 == 0

    lost = world.link.received.heartbeats_lost
    world.relay.losing = every_third
    await asyncio.sleep(12.0)
    world.relay.losing = lambda number: False
    flown = world.mode("offboard")() and world.streamer.report().silence is None
    world.rows.append(Row("every third heartbeat lost", "flown on" if flown else f"{world.streamer.report().silence}"))
    counted = world.link.received.heartbeats_lost - lost
    world.rows.append(Row("every third heartbeat lost", "counted" if counted >= 3 else f"{counted} counted"))


async def _setpoints_come_back(world: World) -> None:
    """Sent past the streamer, which sends nothing in a failsafe: the autopilot goes back by itself."""
    begun = time.monotonic()
    while time.monotonic() - begun < 3.0 and not world.mode("offboard")():
        world.link.send_setpoint(Setpoint(world.clock(), np.zeros(2), HEIGHT_M, 0.0))
        await asyncio.sleep(0.05)
    back = world.mode("offboard")()
    what = "back in offboard by itself" if back else "stays in its failsafe"
    world.rows.append(Row("setpoints come back", what, round(time.monotonic() - begun, 2)))


async def others_interfere(world: World) -> None:
    """Another program's setpoints, a changed parameter."""
    link, station = world.link, world.station
    await world.offboard()
    await asyncio.sleep(2.0)
    foreign = asyncio.create_task(_stream(station))
    await world.saw("foreign setpoints", lambda: link.status().foreign_setpoints is not None, "noticed")
    world.rows.append(Row("foreign setpoints", f"{link.status().foreign_setpoints}"))
    foreign.cancel()
    await world.saw("foreign setpoints", lambda: link.status().foreign_setpoints is None, "over")
    station.set_parameter(0, "COM_OF_LOSS_T", 20.0)
    await world.saw("COM_OF_LOSS_T 20", lambda: link.status().parameter_fault is not None, "noticed")
    world.rows.append(Row("COM_OF_LOSS_T 20", f"{link.status().parameter_fault}"))
    station.set_parameter(0, "COM_OF_LOSS_T", 1.0)
    await world.saw("COM_OF_LOSS_T 1", lambda: link.status().parameter_fault is None, "over")
    await world.hold()
    station.set_parameter(0, "NAV_DLL_ACT", 2)
    await world.saw("NAV_DLL_ACT 2", lambda: not link.announces(), "flockd does not announce itself any more")
    station.set_parameter(0, "NAV_DLL_ACT", 0)
    await world.saw("NAV_DLL_ACT 0", link.announces, "it does again")


async def _stream(station: Meddler) -> None:
    while True:
        station.send_velocity(0, np.array([0.0, 3.0]))
        await asyncio.sleep(0.05)


async def text(world: World) -> None:
    """PX4 forwards it to a ground station's link; the fake has one link for all."""
    with Meddler([GROUND_STATION_PORT], world.clock) as ground:
        await world.until(lambda: bool(ground.mode(0)) or world.station.is_connected(0), "a heartbeat")
        await asyncio.sleep(1.5)  # the autopilot has heard the ground station's heartbeat
        world.link.send_text(TEXT, Severity.WARNING)
        await world.saw("text", lambda: TEXT in {ground.last_text(0), world.station.last_text(0)}, "it is whole")


async def landing(world: World) -> None:
    """The end."""
    link = world.link
    await world.asked("land", link.land)
    await world.saw("land", world.mode("land"), "the mode is land")
    await world.until(lambda: not link.status().armed and link.status().landed_state == "ground", "landed", 60.0)
    world.rows.append(Row("land", f"disarmed on the ground, in mode {link.status().flight_mode}"))


async def starting_anew(world: World) -> None:
    """Its program ends, and begins again."""
    await world.hold()
    world.texts()
    world.restart()
    await world.saw(
        "restart", lambda: any("started anew" in report for report in world.reports), "noticed by its clock"
    )
    await world.saw("restart", lambda: _rate(world) is True, "its streams come as requested")


def _rate(world: World) -> bool:
    """The attitude comes at more than the 10 Hz or 50 Hz of its own accord: CURRENT_MODE was requested."""
    return world.link.received.restarts > 0 and world.link.knows_checks()


Story = Callable[[World], Awaitable[None]]
CONTRACT: tuple[Story, ...] = (on_the_ground, take_off, in_flight, others_interfere, text, landing, starting_anew)


def _pass(now_s: float, request: Request) -> Verdict:
    """A gate that allows all: these stories are about the autopilot."""
    wanted = request.wanted
    return Verdict(Setpoint(now_s, wanted.velocity, HEIGHT_M, 0.0), ())


def _in_circles() -> FloatArray:
    angle = 0.3 * time.monotonic()
    return NORTH_M_S * np.array([np.cos(angle), np.sin(angle)])


async def _offer(world: World) -> None:
    nowhere = around(yaw_rad=0.0, height_m=HEIGHT_M)
    while True:
        now = world.clock()
        wanted = Wanted(_in_circles(), np.zeros(2), 0.0, height_m=HEIGHT_M)
        world.streamer.offer(Request(Permission(Action.FLY, now), wanted, now, 0.0, nowhere))
        world.streamer.beat()
        await asyncio.sleep(0.05)


async def _ask(link: AutopilotLink) -> None:
    """For its checks, as the daemon does while it does not know them."""
    while True:
        if not link.knows_checks() and not link.status().armed:
            with suppress(AutopilotError):
                await link.ask_for_checks()
        await asyncio.sleep(1.0)


Make = Callable[[ExitStack], tuple[Autopilots, Callable[[], None]]]
"""An autopilot, and what starts it anew."""


def _fake(stack: ExitStack) -> tuple[Autopilots, Callable[[], None]]:
    fakes = SimulatedAutopilots(one_drone(HEIGHT_M), 1.0, lambda north, _: np.zeros_like(north))
    return stack.enter_context(fakes), lambda: fakes.fakes[0].restart()  # noqa: PLW0108 - there is none before it starts


def _px4(stack: ExitStack) -> tuple[Autopilots, Callable[[], None]]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="contract-")))
    first, again = (
        stack.enter_context(Px4s(one_drone(HEIGHT_M), 1.0, os.environ, folder / name, {}))
        for name in ("first", "again")
    )

    def restart() -> None:
        first.__exit__(None, None, None)
        again.start()

    return first, restart


async def _fly(make: Make) -> list[Row]:
    clock = time.monotonic
    with ExitStack() as stack:
        autopilots, restart = make(stack)
        ports, flockd_port = autopilots.ports[0], free_port()
        relay = stack.enter_context(Relay(ports.offboard, flockd_port))
        station = stack.enter_context(Meddler([ports.truth], clock))
        autopilots.start()
        begun = time.monotonic()
        while not station.is_connected(0):
            if time.monotonic() - begun > START_S:
                raise UnavailableError("the autopilot sends nothing")
            await asyncio.sleep(0.05)
        station.request_messages()
        parameters = AutopilotParameters(address=f"udpin://127.0.0.1:{flockd_port}")
        link = await PilotsLink.connect(parameters, timeout_s=START_S, clock=clock)
        streamer = SetpointStreamer(link.send_setpoint, link.status, _pass, parameters, SafetyParameters(), clock=clock)
        streamer.start()
        world = World(link, streamer, station, relay, restart, clock)
        runs = [link.attend(), link.synchronise(), _offer(world), _ask(link)]
        tasks = [asyncio.create_task(run) for run in runs]
        try:
            for story in CONTRACT:
                try:
                    await story(world)
                except (UnavailableError, AutopilotError) as error:
                    world.rows.append(Row(story.__name__, f"ended: {error}"))
            return world.rows
        finally:
            for task in tasks:
                task.cancel()
            streamer.close()
            await link.close()


def seen(autopilot: str) -> list[Row]:
    """What flockd sees of one of them. Raises UnavailableError."""
    rows = asyncio.run(_fly({"fake": _fake, "px4": _px4}[autopilot]))
    for row in rows:
        print(f"{row.story:32}{row.what}" + ("" if row.after_s is None else f", after {row.after_s:.1f} s"))  # noqa: T201
    return rows
