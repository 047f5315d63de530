"""The daemon: puts everything together, starts and ends it, and looks after its tasks."""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, NamedTuple

from flockd import __version__
from flockd.autopilot.mavsdk_link import AutopilotLink
from flockd.autopilot.status import AutopilotError
from flockd.autopilot.streamer import SetpointStreamer
from flockd.config import DroneConfig
from flockd.config.autopilot import AutopilotParameters
from flockd.daemon.chronicle import Chronicle
from flockd.daemon.computer import LoopLag, Thermometer, WallClock
from flockd.daemon.control import FLYING, Control, Door, VehicleHistory
from flockd.daemon.crew import Crew
from flockd.daemon.inspection import Asked, Inspector
from flockd.daemon.networks import InterruptibleNetworks, WatchedNetworks
from flockd.daemon.preview import preview
from flockd.daemon.reports import tell_for_ever, tell_service
from flockd.daemon.requests import Requests, TakeOff
from flockd.daemon.service import ServiceManager
from flockd.daemon.sight import Sight
from flockd.daemon.worker import BusyError, LateError, Worker
from flockd.errors import ConfigError, ConfigProblem, FlockdError
from flockd.safety import Decision, Event, Gate, State
from flockd.sources import open_source
from flockd.telemetry.publisher import ZenohTelemetry
from flockd.telemetry.topics import (
    AboutMessage,
    AnswerMessage,
)

LOAD_S = 60.0
"""To load the networks from a slow card."""
OPEN_S = 10.0
CLOSE_S = 3.0
LAST_RESORT_S = 2.0


class DaemonError(FlockdError):
    """The flight ended because something in flockd did; the text says what."""


class Ending(NamedTuple):
    """How a daemon ended that ended well."""

    reload: DroneConfig | None
    """Begin again, with this configuration; None: done."""


class Daemon:
    """One drone's flight program, from its start to its end. `run` once."""

    def __init__(
        self,
        config: DroneConfig,
        file: str,
        *,
        load_networks: Callable[[], InterruptibleNetworks],
        models: Mapping[str, str],
        recordings: Path | None,
        service: ServiceManager,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``file`` is named in errors; ``models`` are the SHA-256 of each, by name, for the recordings.

        Raises ConfigError for a configuration that cannot be flown.
        """
        self._autopilot = _autopilot_of(config, file)
        self._source = open_source(config, file, clock=clock)
        self._config, self._file = config, file
        self._load_networks, self._models, self._recordings = load_networks, models, recordings
        self._service, self._clock = service, clock
        self._asked = Asked()
        self._stopping = asyncio.Event()
        self._reload: DroneConfig | None = None
        self._crew: Crew | None = None

    def ask_to_stop(self) -> None:
        """As SIGTERM does: standstill, Hold, and the end."""
        self._asked.shutdown = True
        self._stopping.set()

    def ask_to_reload(self, read: Callable[[], DroneConfig]) -> None:
        """As SIGHUP does: begins again with what ``read`` gives, unless the drone flies or the file is wrong."""
        refusal = self._why_not_reload()
        if refusal is None:
            try:
                config = read()
                _autopilot_of(config, self._file)
                open_source(config, self._file)
            except FlockdError as error:
                refusal = f"the configuration was not taken, and the old one stays: {error}"
            else:
                self._reload = config
                self._service.reloading()
                self.ask_to_stop()
                return
        if self._crew is not None:
            self._crew.chronicle.event(refusal)

    async def run(self) -> Ending:
        """Flies until it is asked to stop.

        Raises FlockdError when it cannot start, DaemonError when something in it died or Hold was not confirmed.
        """
        async with AsyncExitStack() as stack:
            crew = await self._unless_stopped(self._board(stack))
            if crew is not None:
                self._crew = crew
                await self._fly(crew)
        return Ending(self._reload)

    def _why_not_reload(self) -> str | None:
        if self._crew is None:
            return None
        state, status = self._crew.control.decision.state, self._crew.link.status()
        if state in FLYING or status.in_air or status.armed:
            return "the configuration was not read again, because the drone is armed or in the air; land and disarm it"
        return None

    async def _unless_stopped(self, start: Coroutine[Any, Any, Crew]) -> Crew | None:
        """Starts, or stops starting when asked to stop."""
        starting = asyncio.create_task(start)
        stopping = asyncio.create_task(self._stopping.wait())
        try:
            await asyncio.wait({starting, stopping}, return_when=asyncio.FIRST_COMPLETED)
            return starting.result() if starting.done() else None
        finally:
            stopping.cancel()
            starting.cancel()
            await asyncio.wait({starting})

    async def _board(self, stack: AsyncExitStack) -> Crew:
        """Opens everything; what was opened is closed by the stack, in the reverse order."""
        config, clock = self._config, self._clock
        closing = Worker("closing", backlog=8)
        stack.callback(closing.leave)
        telemetry = await closing.do(OPEN_S, _open_telemetry, config)
        stack.push_async_callback(_patiently, closing, telemetry.close)
        chronicle = Chronicle(config, telemetry, self._models, self._recordings, clock)
        stack.push_async_callback(_shrug, chronicle.close)
        await closing.do(OPEN_S, self._source.start)
        stack.push_async_callback(_patiently, closing, self._source.stop)
        networks, link = await _both(self._networks(), AutopilotLink.connect(self._autopilot, clock=clock))
        stack.push_async_callback(_shrug, link.close)
        gate = Gate(config.safety.gate)
        door = Door(gate, clock)
        streamer = SetpointStreamer(link.send_setpoint, link.status, door, self._autopilot, clock=clock)
        streamer.start()
        stack.callback(streamer.close)
        history, lag, thermometer = VehicleHistory(), LoopLag(clock), Thermometer()
        sight = Sight(config, self._source, networks, history.at, chronicle.step, chronicle.event, clock)
        stack.push_async_callback(_patiently, closing, sight.leave)
        dead: dict[str, str] = {}
        inspector = Inspector(config, self._source, sight, networks, gate, lag, thermometer, dead, clock)
        requests = Requests(link, chronicle.event)
        control = Control(
            config, link, streamer, door, sight, inspector, requests, history, self._asked, self._on_tick, clock
        )  # fmt: skip
        take_off = TakeOff(link, streamer, self._asked, lambda: control.decision, chronicle.event)
        crew = Crew(
            link=link, streamer=streamer, source=self._source, sight=sight, networks=networks, control=control,
            requests=requests, take_off=take_off, chronicle=chronicle, telemetry=telemetry, lag=lag,
            thermometer=thermometer, wall_clock=WallClock(chronicle.event, time.monotonic), dead_tasks=dead,
        )  # fmt: skip
        taker = self._taker(asyncio.get_running_loop(), chronicle)
        telemetry.announce(config.name, self._about(), taker, functools.partial(_picture, sight))
        return crew

    async def _networks(self) -> WatchedNetworks:
        loading = Worker("loading")
        try:
            networks = await loading.do(LOAD_S, self._load_networks)
        finally:
            loading.leave()
        return WatchedNetworks(networks, self._config.perception.deadline_s / self._config.speed_factor)

    async def _fly(self, crew: Crew) -> None:
        """One task a concern, until all is over."""
        concerns = {
            "control": crew.control.run,
            "requests": crew.requests.run,
            "sight": crew.sight.run,
            "loop lag": crew.lag.run,
            "thermometer": crew.thermometer.run,
            "wall clock": crew.wall_clock.run,
            "telemetry": lambda: tell_for_ever(crew, self._clock),
            "service": lambda: tell_service(crew, self._service),
        }
        if self._autopilot.arm_and_take_off:
            concerns["take-off"] = crew.take_off.run
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(self._watched(name, run, crew), name=name) for name, run in concerns.items()]
            await crew.over.wait()
            self._service.stopping()
            for task in tasks:
                task.cancel()
        self._judge(crew)

    async def _watched(self, name: str, run: Callable[[], Awaitable[None]], crew: Crew) -> None:
        """A task that ends is an event for the supervisor, which ends the flight; it does not end the others."""
        try:
            await run()
            crew.dead_tasks[name] = "it returned"
        except Exception as error:  # noqa: BLE001 - whatever it is, the drone has to be handed over
            crew.dead_tasks[name] = repr(error)
        crew.chronicle.event(f"the task {name} died: {crew.dead_tasks[name]}")
        if name in {"control", "requests"}:
            await self._last_resort(crew)

    async def _last_resort(self, crew: Crew) -> None:
        """Who would ask the autopilot to take over is dead: asks it here, while the streamer sends standstill."""
        crew.control.stand_still()
        if crew.link.status().flight_mode == "offboard":
            try:
                async with asyncio.timeout(LAST_RESORT_S):
                    await crew.link.hold()
            except (AutopilotError, TimeoutError) as error:
                crew.chronicle.event(f"the autopilot did not confirm Hold ({error}); silence makes it")
        crew.streamer.end("a task died")
        crew.over.set()

    def _judge(self, crew: Crew) -> None:
        """Raises DaemonError unless all ended as it should."""
        if crew.dead_tasks:
            told = "; ".join(f"{name}: {why}" for name, why in crew.dead_tasks.items())
            raise DaemonError(f"flockd had to give up, because a task died ({told}); see its log")
        if Event.NO_ANSWER in {reason.event for reason in crew.control.decision.reasons}:
            raise DaemonError("the autopilot did not confirm Hold; flockd fell silent, which makes its failsafe act")

    def _on_tick(self, before: Decision, now: Decision) -> None:
        """Of the control loop."""
        crew = self._crew
        assert crew is not None
        if not crew.networks.hopeless:
            self._service.alive()
        if now.state is not before.state:
            why = "; ".join(reason.sentence for reason in now.reasons)
            crew.chronicle.event(f"{now.state}: {why}" if why else str(now.state))
        if now.state in FLYING and before.state not in FLYING:
            crew.chronicle.begin_recording()
        elif crew.chronicle.recording is not None and not crew.link.status().armed:
            crew.chronicle.end_recording()
        handed_over = now.state in {State.IDLE, State.SILENT} and not crew.requests.asking
        if (self._asked.shutdown or crew.dead_tasks) and handed_over:
            crew.over.set()

    def _about(self) -> AboutMessage:
        return AboutMessage(
            version=__version__,
            configuration=self._config.model_dump(mode="json"),
            commands=list(self._config.telemetry.commands),
        )

    def _taker(self, loop: asyncio.AbstractEventLoop, chronicle: Chronicle) -> Callable[[str], AnswerMessage]:
        """What takes operators' commands, on threads of zenoh's."""
        allowed = self._config.telemetry.commands

        def take(command: str) -> AnswerMessage:
            if command not in allowed:
                sentence = f"{command!r} is not allowed here; telemetry.commands allows {', '.join(allowed) or 'none'}"
                chronicle.event(f"an operator's command was refused: {sentence}")
                return AnswerMessage(accepted=False, sentence=sentence)
            loop.call_soon_threadsafe(self._obey, command)
            chronicle.event(f"an operator asked for {command}")
            return AnswerMessage(accepted=True, sentence=f"{command} is being tried; the topic `flight` tells")

        return take

    def _obey(self, command: str) -> None:
        self._asked.hold = command == "hold"
        self._asked.land = command == "land"
        self._asked.resume = command == "resume"


def _autopilot_of(config: DroneConfig, file: str) -> AutopilotParameters:
    if config.autopilot is None:
        problem = ConfigProblem(file, 0, "autopilot", "is missing; add it with the `address` of the autopilot")
        raise ConfigError([problem])
    return config.autopilot


def _picture(sight: Sight, camera: str) -> bytes | None:
    frame = None if sight.frames is None else sight.frames.frames.get(camera)
    return None if frame is None else preview(frame)


def _open_telemetry(config: DroneConfig) -> ZenohTelemetry:
    wanted = config.telemetry
    settings = None if wanted.zenoh_config is None else Path(wanted.zenoh_config)
    return ZenohTelemetry(wanted.fleet, listen=wanted.listen, connect=wanted.connect, settings=settings)


async def _both(
    networks: Coroutine[Any, Any, WatchedNetworks], link: Coroutine[Any, Any, AutopilotLink]
) -> tuple[WatchedNetworks, AutopilotLink]:
    """Both at a time; when one fails the other is given up."""
    tasks = asyncio.create_task(networks), asyncio.create_task(link)
    try:
        return await asyncio.gather(*tasks)
    except BaseException:
        for task in tasks:
            task.cancel()
        raise


async def _patiently(worker: Worker, close: Callable[[], None]) -> None:
    """Closes something that may hang; then it ends with the process."""
    try:
        await worker.do(CLOSE_S, close)
    except (LateError, BusyError):
        return


async def _shrug(close: Callable[[], Awaitable[None]]) -> None:
    """The same, for what closes itself."""
    try:
        async with asyncio.timeout(2 * CLOSE_S):
            await close()
    except (TimeoutError, LateError, BusyError):
        return
