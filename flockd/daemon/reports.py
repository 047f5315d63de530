"""What the daemon says of itself, again and again: to watchers, and to the service manager."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping

from flockd.daemon.crew import Crew
from flockd.daemon.service import ServiceManager
from flockd.safety import Decision
from flockd.telemetry import TOPICS
from flockd.telemetry.topics import CameraMessage, ComputerMessage, FlightMessage, ReasonMessage

START_LOOK_S = 0.1
START_MORE_S = 10.0
STATUS_EVERY_S = 2.0


async def tell_service(crew: Crew, service: ServiceManager) -> None:
    """Ready with the first frame; before that, and after it, what is the matter. For ever."""
    while crew.sight.frames is None:
        faults = [status.fault for status in crew.source.status().values() if status.fault]
        service.starting(f"waits for frames: {'; '.join(faults) or 'none came yet'}", START_MORE_S)
        await asyncio.sleep(START_LOOK_S)
    service.ready(_status_line(crew.control.decision))
    crew.chronicle.event("ready: models loaded, autopilot heard, first frames seen")
    told: set[str] = set()
    while True:
        for note in set(crew.source.notes()) - told:
            crew.chronicle.event(note)
            told.add(note)
        await asyncio.sleep(STATUS_EVERY_S)
        service.status(_status_line(crew.control.decision))


async def tell_for_ever(crew: Crew, clock: Callable[[], float]) -> None:
    """What does not follow from a step of the pilot, at the rates of the table of topics."""
    messages: dict[str, Callable[[float], Mapping[str, object]]] = {
        "flight": lambda now: _flight_message(crew, now),
        "computer": lambda now: _computer_message(crew, now),
    }
    due_s = dict.fromkeys(messages, clock())
    while True:
        for topic, message in messages.items():
            rate_hz = TOPICS[topic].rate_hz
            assert rate_hz is not None
            now = clock()
            if now >= due_s[topic]:
                due_s[topic] = now + 1.0 / rate_hz
                crew.chronicle.publish(topic, message(now))
        await asyncio.sleep(max(0.0, min(due_s.values()) - clock()))


def _status_line(decision: Decision) -> str:
    reasons = "; ".join(reason.sentence for reason in decision.reasons)
    return f"{decision.state}: {reasons}" if reasons else str(decision.state)


def _flight_message(crew: Crew, now: float) -> FlightMessage:
    decision, status, stream = crew.control.decision, crew.link.status(), crew.streamer.report()
    vehicle = crew.link.vehicle_state()
    return FlightMessage(
        time_s=now,
        state=decision.state.value,
        reasons=[ReasonMessage(event=reason.event.value, sentence=reason.sentence) for reason in decision.reasons],
        flight_mode=status.flight_mode,
        armed=None if math.isinf(status.heartbeat_age_s) else status.armed,
        in_air=None if status.landed_state == "unknown" else status.in_air,
        heartbeat_age_s=status.heartbeat_age_s,
        battery_share=status.battery_share,
        height_m=None if vehicle is None else vehicle.height_m,
        velocity_trim=_velocity_trim(crew),
        silence=stream.silence,
        setpoints_sent=stream.sent,
        setpoints_missed=stream.missed,
    )


def _velocity_trim(crew: Crew) -> list[float]:
    """(2,) m/s, north and east, of the newest command."""
    newest = crew.sight.newest
    trim = None if newest is None else newest.output.command.trim
    return [0.0, 0.0] if trim is None else [float(v) for v in trim]


def _computer_message(crew: Crew, now: float) -> ComputerMessage:
    cameras = {
        name: CameraMessage(
            age_s=camera.age_s,
            fault=camera.fault,
            counts={str(what): number for what, number in camera.counts.items()},
        )
        for name, camera in crew.source.status().items()
    }
    return ComputerMessage(
        time_s=now,
        cameras=cameras,
        load=crew.sight.load(),
        steps=crew.sight.steps,
        steps_failed=crew.sight.failed,
        network_faults=crew.networks.faults,
        networks_stuck=crew.networks.ended,
        loop_lag_s=crew.lag.worst_s(),
        temperature_c=crew.thermometer.hottest_c,
        messages_lost=crew.chronicle.lost + crew.telemetry.lost,
        recording=crew.chronicle.recording,
    )
