"""Periodic status of the daemon, for telemetry and for the service manager, by sd_notify(3)."""

from __future__ import annotations

import asyncio
import math
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from flockd.flight.safety import Decision, Event, Gate, State
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.daemon.autopilot_tasks import (
    AutopilotRequests,
    RefusalWatch,
    StateTexts,
    state_sentence,
)
from flockd.onboard.daemon.control import Control
from flockd.onboard.daemon.message_sinks import MessageSinks
from flockd.onboard.daemon.operator_orders import OperatorCommands
from flockd.onboard.daemon.pilot_loop import PilotLoop
from flockd.onboard.daemon.supervisor_inputs import LoopLag, Thermometer
from flockd.onboard.daemon.watched_networks import WatchedNetworks
from flockd.onboard.sources import FrameSource
from flockd.onboard.telemetry import TOPICS, topics
from flockd.onboard.telemetry.publisher import ZenohTelemetry

START_POLL_S = 0.1
START_MORE_S = 10.0
STATUS_EVERY_S = 2.0
STATUS_POLL_S = 0.05
"""Longest delay of a new status, so that its lines keep the order of events."""


@dataclass(frozen=True, eq=False)
class Components:
    """The parts of a running daemon, created and connected by `Daemon`."""

    link: AutopilotLink
    gate: Gate
    streamer: SetpointStreamer
    source: FrameSource
    pilot_loop: PilotLoop
    networks: WatchedNetworks
    control: Control
    requests: AutopilotRequests
    refusals: RefusalWatch
    texts: StateTexts
    sinks: MessageSinks
    telemetry: ZenohTelemetry
    commands: OperatorCommands
    lag: LoopLag
    thermometer: Thermometer
    dead_tasks: dict[str, str]
    """Why each dead task ended, by name."""
    over: asyncio.Event = field(default_factory=asyncio.Event)
    """Set when the flight is over and the tasks may end."""

    def lacks_frames(self) -> str | None:
        """Why no frames have come yet; None: some have."""
        faults = [status.fault for status in self.source.status().values() if status.fault]
        return "; ".join(faults) or "none came yet" if self.pilot_loop.frames is None else None


async def notify_service_manager(components: Components, service: ServiceManager) -> None:
    """Reports ready with the first frame, and a status line before and after it, until cancelled."""
    while (why := components.lacks_frames()) is not None:
        service.starting(f"waits for frames: {why}", START_MORE_S)
        await asyncio.sleep(START_POLL_S)
    sent = components.control.decision
    service.ready(state_sentence(sent))
    components.sinks.event("ready: models loaded, autopilot heard, first frames seen")
    loop = asyncio.get_running_loop()
    while True:
        until = loop.time() + STATUS_EVERY_S
        while _matters(components.control.decision) == _matters(sent) and loop.time() < until:
            await asyncio.sleep(STATUS_POLL_S)
        sent = components.control.decision
        service.status(state_sentence(sent))


async def publish_status(components: Components, clock: Callable[[], float]) -> None:
    """Publishes `flight` and `computer` at the rates in the table of topics, until cancelled."""
    messages: dict[str, Callable[[float], Mapping[str, object]]] = {
        "flight": lambda now: _flight_message(components, now),
        "computer": lambda now: _computer_message(components, now),
    }
    due_s = dict.fromkeys(messages, clock())
    while True:
        for topic, message in messages.items():
            rate_hz = TOPICS[topic].rate_hz
            assert rate_hz is not None
            now = clock()
            if now >= due_s[topic]:
                due_s[topic] = now + 1.0 / rate_hz
                components.sinks.publish(topic, message(now))
        await asyncio.sleep(max(0.0, min(due_s.values()) - clock()))


def _matters(decision: Decision) -> tuple[State, tuple[Event, ...]]:
    """What changes a status line, apart from its numbers."""
    return decision.state, tuple(reason.event for reason in decision.reasons)


def _flight_message(components: Components, now: float) -> topics.FlightMessage:
    decision, status, stream = components.control.decision, components.link.status(), components.streamer.report()
    vehicle, refusals = components.link.vehicle_state(), components.refusals.current
    newest = components.pilot_loop.newest
    trim = None if newest is None else newest.output.command.trim
    return topics.FlightMessage(
        time_s=now,
        state=decision.state.value,
        reasons=[
            *(topics.ReasonMessage(event=reason.event.value, sentence=reason.sentence) for reason in decision.reasons),
            *(topics.ReasonMessage(event=refusal.reason, sentence=refusal.sentence) for refusal in refusals),
        ],
        flight_mode=status.flight_mode,
        armed=None if math.isinf(status.heartbeat_age_s) else status.armed,
        in_air=None if status.landed_state == "unknown" else status.in_air,
        heartbeat_age_s=status.heartbeat_age_s,
        heartbeats_lost=components.link.received.heartbeats_lost,
        battery_share=status.battery_share,
        height_m=None if vehicle is None else vehicle.height_m,
        velocity_trim=[0.0, 0.0] if trim is None else trim.tolist(),
        velocity_error_m_s=components.gate.response.error_m_s,
        silence=stream.silence,
        setpoints_sent=stream.sent,
        setpoints_missed=stream.missed,
        orders=components.commands.recent(),
        orders_refused=components.commands.refused,
    )


def _computer_message(components: Components, now: float) -> topics.ComputerMessage:
    noisy = components.pilot_loop.noisy_images
    cameras = {
        name: topics.CameraMessage(
            age_s=camera.age_s,
            fault=camera.fault,
            counts={str(what): n for what, n in camera.counts.items()}
            | ({"noisy": noisy[name]} if noisy[name] else {}),
        )
        for name, camera in components.source.status().items()
    }
    return topics.ComputerMessage(
        time_s=now,
        cameras=cameras,
        load=components.pilot_loop.load(),
        steps=components.pilot_loop.steps,
        steps_failed=components.pilot_loop.failed,
        network_faults=components.networks.faults,
        networks_stuck=components.networks.ended,
        loop_lag_s=components.lag.worst_s(),
        temperature_c=components.thermometer.hottest_c,
        messages_lost=components.sinks.lost + components.telemetry.lost,
        recording=components.sinks.recording,
    )


FEEDS_A_PERIOD = 4
"""How often the watchdog is fed in its period."""


class ServiceManager:
    """systemd, if it started this process with a notify socket; else does nothing. Sending never waits or fails."""

    def __init__(self, environment: Mapping[str, str], *, clock: Callable[[], float] = time.monotonic) -> None:
        """``environment``: the process's own: NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID."""
        self._clock = clock
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        meant = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._period_s = int(environment.get("WATCHDOG_USEC", "0")) * 1e-6 if meant else 0.0
        self._fed_s = float("-inf")

    def ready(self, status: str) -> None:
        """Reports that startup is complete."""
        self._send("READY=1", f"STATUS={status}")

    def status(self, status: str) -> None:
        """Sends one line for people."""
        self._send(f"STATUS={status}")

    def starting(self, status: str, more_s: float) -> None:
        """Not ready yet: extends the start time-out by ``more_s``."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(more_s * 1e6)}", f"STATUS={status}")

    def stopping(self) -> None:
        """Reports that the process is about to end."""
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feeds the watchdog when due. Only the control loop may call it: the watchdog detects that it hangs."""
        now = self._clock()
        if self._period_s and now - self._fed_s >= self._period_s / FEEDS_A_PERIOD:
            self._fed_s = now
            self._send("WATCHDOG=1")

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:  # the flight goes on; the manager's watchdog decides
            return
