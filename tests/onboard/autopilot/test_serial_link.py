"""A serial link: it costs nothing at rest, has one owner, and comes back with its device."""

from __future__ import annotations

import asyncio
import os
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.config.autopilot import LEAST_BAUD, AutopilotParameters
from flockd.core.messages import Setpoint
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import STREAMS_HZ, AutopilotLink
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests.calm import clock
from tests.onboard.autopilot.conftest import HEARTBEAT_S
from tests.onboard.autopilot.flight import attended, until
from tests.onboard.autopilot.serial_cable import SerialCable

ALLOWED_SHARE = 0.03
"""Of one core, for a link at rest."""
NOBODY = 65534


def _spent_s(but: set[int]) -> float:
    """Processor time of this process's threads other than these, seconds."""
    total = 0
    for thread in Path("/proc/self/task").iterdir():
        if int(thread.name) not in but:
            total += sum(map(int, (thread / "stat").read_text(encoding="ascii").rpartition(")")[2].split()[11:13]))
    return total / os.sysconf("SC_CLK_TCK")


@pytest.mark.fault("serial-port")
async def test_at_rest_it_costs_under_three_hundredths_of_a_core(
    fake_autopilot: FakeAutopilot, cable: SerialCable
) -> None:
    others = {thread.native_id for thread in threading.enumerate() if thread.native_id is not None}
    async with attended(cable.address):
        fake_autopilot.silent = True
        began_s, spent_s = time.monotonic(), _spent_s(others)
        await asyncio.sleep(6.0)
        assert _spent_s(others) - spent_s < ALLOWED_SHARE * (time.monotonic() - began_s)


@pytest.mark.fault("serial-port")
async def test_it_comes_back_with_the_device_which_has_forgotten_its_streams(
    fake_autopilot: FakeAutopilot, cable: SerialCable
) -> None:
    async with attended(cable.address) as link:
        asked = dict(fake_autopilot.streams.intervals_s)
        cable.unplug()
        await until(lambda: link.status().heartbeat_age_s > 4 * HEARTBEAT_S)
        assert link.unusable() is None, "it may only have started anew"
        link.send_setpoint(Setpoint(0.0, np.zeros(2), 2.5, 0.0))
        fake_autopilot.streams.intervals_s.update(dict.fromkeys(asked, 9.0))
        cable.plug_in()
        await until(lambda: link.status().heartbeat_age_s < HEARTBEAT_S)
        await until(lambda: dict(fake_autopilot.streams.intervals_s) == asked)
        assert await link.parameter("COM_OBL_RC_ACT", int) == 5, "both ways"
        assert not fake_autopilot.setpoints, "what was sent meanwhile is not sent later"
        gone, back = link.take_reports()[:2]
        assert gone.startswith(f"the autopilot's serial port {cable.device} is gone (")
        assert back.startswith(f"the autopilot's serial port {cable.device} is back after ")


@pytest.mark.fault("serial-port")
async def test_no_other_program_can_open_it_whoever_starts_it(
    fake_autopilot: FakeAutopilot, cable: SerialCable
) -> None:
    user = NOBODY if os.geteuid() == 0 else None  # root may open all

    def opens() -> subprocess.CompletedProcess[str]:
        command = ["sh", "-c", f": <>{os.path.realpath(cable.device)}"]
        return subprocess.run(command, user=user, cwd="/", capture_output=True, text=True, check=False)

    async with attended(cable.address):
        refused = await asyncio.to_thread(opens)
        assert "Device or resource busy" in refused.stderr
    allowed = await asyncio.to_thread(opens)
    assert allowed.returncode == 0, allowed.stderr


def test_the_least_baud_rate_carries_what_is_asked_for() -> None:
    """With every field, as MAVLink 2 leaves out zeros at the end; 12 bytes around each message, ten bits a byte."""
    bytes_a_second = sum(
        (getattr(mavlink, f"MAVLink_{name.lower()}_message").unpacker.size + 12) * rate_hz
        for name, (_, rate_hz) in STREAMS_HZ.items()
        if name != "DISTANCE_SENSOR"
    )
    assert 38_400 < 10 * bytes_a_second <= LEAST_BAUD


@pytest.mark.parametrize(
    ("address", "code", "told"),
    [
        ("serial:///dev/nowhere:921600", 69, "cannot be opened (No such file or directory); check the"),
        ("serial:///dev/null:921600", 69, "cannot be opened (Inappropriate ioctl for device); check the"),
    ],
)
async def test_what_cannot_be_a_port_is_refused(port: int, address: str, code: int, told: str) -> None:
    with pytest.raises(AutopilotError) as refused:
        await AutopilotLink.connect(AutopilotParameters(address=address), clock=clock)
    assert told in str(refused.value)
    assert refused.value.exit_code == code
