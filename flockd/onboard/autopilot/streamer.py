"""Streams setpoints to the autopilot, and falls silent when anything is wrong: silence stops the drone.

It runs on its own thread with its own deadlines, so that neither busy cores nor a stuck event loop delay it, and sends
only while the control loop runs. PX4 returns to offboard by itself when setpoints come back after its failsafe; so a
stream that was interrupted in flight stays silent until it is begun again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.safety import SafetyParameters
from flockd.core.messages import Setpoint
from flockd.flight.safety import Request, Verdict, link_lost
from flockd.onboard.autopilot.autopilot_status import AutopilotError, AutopilotStatus

Send = Callable[[Setpoint], None]
Gate = Callable[[float, Request], Verdict]
"""As `flockd.flight.safety.Gate.step`: judges each request on the streamer's thread, just before it is sent."""

CLOSE_TIMEOUT_S = 1.0
"""A blocked cable may hold the thread for ever; it then ends with the process."""


@dataclass(frozen=True)
class StreamReport:
    """The streamer's state and counts since its creation."""

    offboard: bool
    """Whether this stream has seen the autopilot in offboard."""
    silence: str | None
    """Why nothing was sent at the last deadline; None: a setpoint was."""
    fault: str | None
    """Why the stream ended by itself, other than by the autopilot leaving offboard; None after `end`."""
    sent: int
    missed: int
    """Deadlines missed because the thread did not run."""


class SetpointStreamer:
    """Passes the newest request through the gate and sends its setpoint, at a fixed rate, while all conditions hold.

    The conditions: the stream was begun; the control loop runs; the request is fresh and passes the gate; the autopilot
    sends messages, is not in its failsafe, and has not left offboard. After the pilot's mode change, a lost link, a gap
    in offboard flight or a fault of the gate the stream stays silent until `begin`. Every method may be called from any
    thread and returns at once.
    """

    def __init__(
        self,
        send: Send,
        status: Callable[[], AutopilotStatus],
        gate: Gate,
        parameters: AutopilotParameters,
        safety: SafetyParameters,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`status` is called before each setpoint; `clock` dates requests; `safety` says when the link is lost."""
        self._send = send
        self._status = status
        self._gate = gate
        self._parameters, self._safety = parameters, safety
        self._clock = clock
        self._request: Request | None = None
        self._beat_s = float("-inf")
        self._stream = _Stream(begun_s=clock(), ended="not begun")
        self._silence: str | None = "not begun"
        self._sent = 0
        self._missed = 0
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Starts the thread; nothing is sent before `begin`."""
        self._thread = threading.Thread(target=self._run, name="setpoints", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the stream and the thread."""
        self.end("closed")
        self._closing.set()
        if self._thread is not None:
            self._thread.join(CLOSE_TIMEOUT_S)

    def begin(self) -> None:
        """Starts streaming, with requests offered from now on."""
        self._request = None
        self._stream = _Stream(begun_s=self._clock())

    def end(self, reason: str) -> None:
        """Silence until `begin`; `reason` is reported unless the stream had ended before. Clears its fault."""
        self._stream.end(reason)
        self._stream.fault = None

    def offer(self, request: Request) -> None:
        """Sets the request for the gate, until a newer one is offered or this one is too old."""
        self._request = request

    def beat(self) -> None:
        """Shows that the control loop runs. The control loop calls it several times in `max_control_age_s`."""
        self._beat_s = self._clock()

    def report(self) -> StreamReport:
        """State and counts so far."""
        stream = self._stream
        self._end_after_a_gap(stream)
        return StreamReport(
            offboard=stream.offboard,
            silence=stream.ended or self._silence,
            fault=stream.fault,
            sent=self._sent,
            missed=self._missed,
        )

    def step(self) -> None:
        """One deadline: sends a setpoint, or keeps the reason why not. The thread calls this."""
        stream = self._stream
        if stream.ended is not None:
            return
        self._end_after_a_gap(stream)  # before the autopilot's failsafe, which follows from the gap
        self._silence = stream.ended or self._watch(stream) or self._send_one(stream)

    def _end_after_a_gap(self, stream: _Stream) -> None:
        """Ends a stream whose last setpoint in offboard flight was sent too long ago."""
        limit_s = self._parameters.max_gap_s
        if stream.offboard and self._clock() - stream.last_sent_s > limit_s:
            why = self._silence or "the thread was stopped"  # SIGSTOP, or a suspended computer
            stream.fail(f"{why}, for more than {limit_s:g} s in offboard flight")

    def _watch(self, stream: _Stream) -> str | None:
        """Why the autopilot's state forbids sending; ends the stream if that is final."""
        status = self._status()
        lost = link_lost(status.heartbeat_age_s, status.message_age_s, self._safety)
        silent_s, limit_s = status.message_age_s, self._parameters.max_gap_s
        if lost is None and stream.offboard and silent_s > limit_s:
            # Meanwhile setpoints may be lost too: the first one to arrive would bring the autopilot back to offboard.
            lost = (
                f"nothing was heard of the autopilot for {silent_s:.1f} s in offboard flight, as when the link is cut"
            )
        if lost is not None:
            stream.fail(lost)
        elif status.flight_mode == "offboard":
            stream.offboard = True
        elif stream.offboard:
            stream.end(f"the autopilot left offboard for {status.flight_mode}")
        elif status.failsafe:
            return "the autopilot is in its failsafe"
        return stream.ended

    def _send_one(self, stream: _Stream) -> str | None:
        """Sends the gate's setpoint for the newest request. Returns why not, if it cannot."""
        request = self._request
        now = self._clock()
        if now - self._beat_s > self._parameters.max_control_age_s:
            return "the control loop is late"
        if request is None:
            return "no setpoint yet"
        if not 0.0 <= now - request.permission.time_s <= self._parameters.max_setpoint_age_s:
            return "the setpoint is not fresh"
        allowed = self._gate(now, request).setpoint
        if allowed is None:
            return "the gate refused"
        if stream.ended is not None:
            return stream.ended
        try:
            self._send(allowed)
        except AutopilotError as error:
            return str(error)
        stream.last_sent_s = now
        self._sent += 1
        return None

    def _run(self) -> None:
        """Keeps deadlines on the real clock; a missed one is counted and not made up for."""
        period_s = 1.0 / self._parameters.setpoint_rate_hz
        deadline = time.monotonic()
        while not self._closing.wait(max(0.0, deadline - time.monotonic())):
            try:
                self.step()
            except Exception as error:  # noqa: BLE001 - whatever fails here ends in silence, and the reason is reported
                self._stream.fail(f"the streamer failed: {error!r}")
            deadline += period_s
            late = int((time.monotonic() - deadline) / period_s)
            if late > 0:
                self._missed += late
                deadline += late * period_s


@dataclass
class _Stream:
    """One stream, from `begin` to its end."""

    begun_s: float
    ended: str | None = None
    fault: str | None = None
    offboard: bool = False
    last_sent_s: float = field(init=False)

    def __post_init__(self) -> None:
        self.last_sent_s = self.begun_s

    def end(self, reason: str) -> None:
        if self.ended is None:
            self.ended = reason

    def fail(self, reason: str) -> None:
        if self.ended is None:
            self.fault = self.ended = reason
