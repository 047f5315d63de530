"""The offset of two clocks from round trips with made-up delays, whose truth is known."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.onboard.autopilot.clock_sync import ClockSync
from flockd.onboard.autopilot.mavlink_messages import ReceivedMessages
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests.calm import clock
from tests.onboard.autopilot.flight import until

OFFSET_S = -47_000.25
"""The autopilot has started 13 hours after the computer."""


def _exchanged(
    sync: ClockSync, times_s: np.ndarray, delays_s: np.ndarray, *, drift: float = 0.0, offset_s: float = OFFSET_S
) -> None:
    """Round trips at the times of the computer's clock, with delays (n, 2) there and back."""
    for sent_s, (there_s, back_s) in zip(times_s, delays_s, strict=True):
        at_s = sent_s + there_s
        sync.add(sent_s, at_s + offset_s + drift * at_s, at_s + back_s)


def _times(seconds: float) -> np.ndarray:
    return np.arange(0.0, seconds, 0.2)


def _error_s(sync: ClockSync, time_s: float, drift: float = 0.0) -> float:
    assert sync.estimate is not None
    return sync.estimate.local_s(time_s + OFFSET_S + drift * time_s) - time_s


@pytest.mark.parametrize("drift", [0.0, 5e-5, -5e-5])
def test_equal_delays_give_the_offset_whatever_crystals_do(drift: float) -> None:
    sync = ClockSync()
    _exchanged(sync, _times(20.0), np.full((100, 2), 0.0015), drift=drift)
    assert sync.estimate is not None
    assert _error_s(sync, 20.5, drift) == pytest.approx(0.0, abs=1e-4)
    assert sync.estimate.round_trip_s == pytest.approx(0.003)
    assert sync.estimate.error_s < 0.0016


@pytest.mark.parametrize("way", [0, 1])
def test_a_busy_computer_that_delays_nine_of_ten_on_one_way_costs_a_third_of_a_millisecond(way: int) -> None:
    random = np.random.default_rng(7)
    delays_s = np.full((100, 2), 0.0003)
    delays_s[:, way] += np.where(random.random(100) < 0.9, random.exponential(0.02, 100), 0.0)
    sync = ClockSync()
    _exchanged(sync, _times(20.0), delays_s)
    assert abs(_error_s(sync, 20.0)) < 3.3e-4
    plain_s = np.mean((delays_s[:, 0] - delays_s[:, 1]) / 2)
    assert abs(plain_s) > 5e-3, "the mean of all would be off by milliseconds"
    assert sync.estimate is not None
    assert abs(_error_s(sync, 20.0)) <= sync.estimate.error_s < 5e-4


def test_a_clock_that_stands_still_at_times_is_not_known_well_however_short_the_round_trips() -> None:
    """As a simulated autopilot's on a computer that is too slow for it."""
    sync = ClockSync()
    for number in range(60):
        stands_s = 0.008 * (number // 7 % 2)
        sync.add(0.2 * number, 0.2 * number + 0.001 + OFFSET_S - stands_s, 0.2 * number + 0.002)
    assert sync.estimate is not None
    assert sync.estimate.error_s == pytest.approx(0.003, abs=0.001), "steps of 8 ms, seen to a millisecond each"


def test_one_round_trip_that_lies_changes_nothing_and_a_new_start_is_a_new_clock() -> None:
    sync = ClockSync()
    _exchanged(sync, _times(10.0), np.full((50, 2), 0.001))
    before = sync.estimate
    sync.add(10.0, 10.0 + OFFSET_S + 5.0, 10.0002)
    assert sync.estimate is before
    _exchanged(sync, _times(2.0) + 10.2, np.full((10, 2), 0.001), offset_s=-9.0)
    assert sync.estimate is not None
    assert sync.estimate.offset_s == pytest.approx(-9.0, abs=1e-4)


def test_impossible_round_trips_and_few_say_nothing() -> None:
    sync = ClockSync()
    sync.add(5.0, 1.0, 4.0)
    sync.add(5.0, 1.0, 7.0)
    _exchanged(sync, _times(0.8), np.full((4, 2), 0.001))
    assert sync.estimate is None


POSITION = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0)
ATTITUDE = {"q1": 1.0, "q2": 0.0, "q3": 0.0, "q4": 0.0}


def test_an_attitude_that_comes_late_is_placed_when_the_autopilot_stamped_it() -> None:
    received = ReceivedMessages(print)
    received.add("LOCAL_POSITION_NED", {**POSITION, "time_boot_ms": 3000}, 103.5)
    received.add("ATTITUDE_QUATERNION", {**ATTITUDE, "time_boot_ms": 3000}, 103.6)
    state = received.vehicle_state()
    assert state is not None
    assert state.time_s == 103.5, "without a known offset by its arrival"
    _exchanged(received.clock, 100.0 + _times(3.0), np.full((15, 2), 0.001), offset_s=-100.0)
    received.add("LOCAL_POSITION_NED", {**POSITION, "time_boot_ms": 3200}, 203.5)
    received.add("ATTITUDE_QUATERNION", {**ATTITUDE, "time_boot_ms": 3990}, 104.1)
    received.add("LOCAL_POSITION_NED", {**POSITION, "time_boot_ms": 4000}, 104.02)
    state = received.vehicle_state()
    assert state is not None
    assert state.time_s == pytest.approx(103.9905, abs=1e-4), "the middle of its millisecond"
    received.add("ATTITUDE_QUATERNION", {**ATTITUDE, "time_boot_ms": 4005}, 104.004)
    received.add("LOCAL_POSITION_NED", {**POSITION, "time_boot_ms": 4010}, 104.01)
    state = received.vehicle_state()
    assert state is not None
    assert state.time_s == pytest.approx(104.004), "never after its arrival"


def test_a_stamp_that_cannot_be_is_not_believed() -> None:
    received = ReceivedMessages(print)
    _exchanged(received.clock, 100.0 + _times(3.0), np.full((15, 2), 0.001), offset_s=-100.0)
    for stamp_ms in (0, 900_000):
        received.add("LOCAL_POSITION_NED", {**POSITION, "time_boot_ms": stamp_ms}, 104.0)
        received.add("ATTITUDE_QUATERNION", {**ATTITUDE, "time_boot_ms": stamp_ms}, 104.0)
        state = received.vehicle_state()
        assert state is not None
        assert state.time_s == 104.0


TURN_DEG_S = 60.0
DELAY_S = 0.003
"""From a stamp to its arrival, and likewise each way of a round trip."""


class Flight:
    """An autopilot that turns, heard for some seconds: attitudes at 50 Hz, clock exchanges at 10 Hz."""

    def __init__(self, lie: Callable[[float], float]) -> None:
        """``lie``: what TIMESYNC's clock is off its stamps', by the computer's time."""
        self.said: list[str] = []
        self.received = ReceivedMessages(self.said.append)
        self._lie, self.random = lie, np.random.default_rng(5)
        self.time_s = 100.0

    def worst_deg(self, seconds: float) -> tuple[float, float]:
        """By how much attitudes are off at the times that they are given, and would be by their arrival."""
        worst, by_arrival, end_s = 0.0, 0.0, self.time_s + seconds
        while self.time_s < end_s:
            self.time_s += 0.02
            late_s = DELAY_S + float(self.random.exponential(0.002))
            true_s, arrived_s = self.time_s, self.time_s + late_s
            fields = {**ATTITUDE, "time_boot_ms": int(1e3 * (true_s - 90.0))}
            self.received.add("LOCAL_POSITION_NED", {**POSITION, "time_boot_ms": fields["time_boot_ms"]}, arrived_s)
            self.received.add("ATTITUDE_QUATERNION", fields, arrived_s)
            state = self.received.vehicle_state()
            assert state is not None
            worst = max(worst, TURN_DEG_S * abs(state.time_s - true_s))
            by_arrival = max(by_arrival, TURN_DEG_S * late_s)
            if round(self.time_s / 0.02) % 5 == 0:
                sent_s = self.time_s + 0.01
                answered_s = sent_s + DELAY_S + float(self.random.exponential(0.001))
                told_s = answered_s - 90.0 + self._lie(answered_s)
                self.received.clock.add(sent_s, told_s, answered_s + DELAY_S)
        return worst, by_arrival


LIES: dict[str, Callable[[float], float]] = {
    "jump ahead": lambda time_s: 0.9 * (time_s > 110.0),
    "jump back": lambda time_s: -0.9 * (time_s > 110.0),
    "creep": lambda time_s: 0.02 * max(time_s - 110.0, 0.0),
    "creep back": lambda time_s: -0.02 * max(time_s - 110.0, 0.0),
    "somebody else's from the start": lambda time_s: 0.4,
}


@pytest.mark.fault("timesync-lies")
@pytest.mark.parametrize("lie", LIES.values(), ids=LIES.keys())
def test_a_lying_timesync_is_not_used_and_said(lie: Callable[[float], float]) -> None:
    """A jump of 0.9 s gave attitudes 53 degrees off in such a turn, a creep of 20 ms a second 35 degrees."""
    flight = Flight(lie)
    flight.worst_deg(10.0)
    worst_deg, by_arrival_deg = flight.worst_deg(20.0)
    assert worst_deg <= by_arrival_deg + TURN_DEG_S * (2 * DELAY_S + 0.005 + 0.001), "what the check lets pass"
    told = [one for one in flight.said if "TIMESYNC" in one]
    assert len(told) == 1, flight.said
    assert told[0].endswith("s off the stamps of its messages; they count from when they arrive")
    assert flight.received.trusted_clock() is None


def test_an_honest_clock_is_used_however_late_single_messages_are() -> None:
    flight = Flight(lambda time_s: 0.0)
    flight.worst_deg(2.0)
    worst_deg, by_arrival_deg = flight.worst_deg(10.0)
    assert worst_deg <= TURN_DEG_S * 0.002 < by_arrival_deg
    assert flight.said == []
    assert flight.received.trusted_clock() is not None


def test_an_autopilot_that_starts_again_does_not_lie() -> None:
    """Its stamps and TIMESYNC begin anew together: for a second messages count from when they arrive."""
    said: list[str] = []
    received = ReceivedMessages(said.append)
    boot_s = 60.0
    for tick in range(1500):
        time_s = 100.0 + 0.02 * tick
        boot_s = time_s if tick == 700 else boot_s
        stamp_ms = int(1e3 * (time_s - boot_s))
        for name, fields in (("LOCAL_POSITION_NED", POSITION), ("ATTITUDE_QUATERNION", ATTITUDE)):
            received.add(name, {**fields, "time_boot_ms": stamp_ms}, time_s + DELAY_S)
        if tick % 5 == 0:
            received.clock.add(time_s, time_s + DELAY_S - boot_s, time_s + 2 * DELAY_S)
        state = received.vehicle_state()
        assert state is not None
        assert abs(state.time_s - time_s) <= DELAY_S + 1e-9
    assert len(said) == 1 and "anew" in said[0]
    assert received.trusted_clock() is not None


def test_a_clock_that_is_right_again_is_believed_after_ten_seconds() -> None:
    flight = Flight(lambda time_s: 0.9 * (105.0 < time_s < 115.0))
    flight.worst_deg(23.0)
    assert flight.received.trusted_clock() is None
    flight.worst_deg(5.0)
    assert flight.received.trusted_clock() is not None
    assert "agrees" in flight.said[-1]


async def test_the_fake_autopilots_known_clock_is_found_through_mavsdk(port: int) -> None:
    with FakeAutopilot(port, clock=clock) as fake_autopilot:
        fake_autopilot.clock_offset_s += 1234.5
        link = await AutopilotLink.connect(AutopilotParameters(address=f"udpin://127.0.0.1:{port}"), clock=clock)
        synchronising = asyncio.create_task(link.synchronise())
        await until(lambda: link.received.trusted_clock() is not None)
        estimate = link.received.trusted_clock()
        assert estimate is not None
        error_s = estimate.offset_s - fake_autopilot.clock_offset_s
        assert abs(error_s) <= estimate.error_s + 1e-6
        synchronising.cancel()
        await link.close()
