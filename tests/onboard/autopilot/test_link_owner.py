"""A link has one owner on a computer, by the autopilot's address, whoever starts it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.errors import UnavailableError
from flockd.onboard.autopilot.link_owner import only_owner
from flockd.sim.sitl.processes import free_port

NOBODY = 65534


def _link(address: str) -> AutopilotParameters:
    return AutopilotParameters(address=address)


@contextmanager
def _held(address: str, *, uid: int | None = None) -> Iterator[None]:
    """By another process, whose runtime folder is another."""
    hold = (
        "import os, time\nfrom flockd.core.config.autopilot import AutopilotParameters\n"
        "from flockd.onboard.autopilot.link_owner import only_owner\n"
        + (f"os.setuid({uid})\n" if uid is not None else "")
        + f"with only_owner(AutopilotParameters(address={address!r})):\n    print('held', flush=True)\n"
        "    time.sleep(60)"
    )
    environment = {**os.environ, "XDG_RUNTIME_DIR": "/nowhere"}
    with subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE, text=True, env=environment) as holder:
        assert holder.stdout is not None
        try:
            assert holder.stdout.readline() == "held\n"
            yield
        finally:
            holder.kill()


@pytest.mark.fault("second-instance")
@pytest.mark.fault("serial-port")
def test_a_second_owner_is_refused_until_the_first_was_killed() -> None:
    one, other = f"udpin://127.0.0.1:{free_port()}", f"udpin://127.0.0.1:{free_port()}"
    with _held(one):
        told = f"autopilot.address: another flockd has the link {one}; stop it first"
        with pytest.raises(UnavailableError, match=told), only_owner(_link(one)):
            pytest.fail("two own it")
        with only_owner(_link(other)):
            pass
    with only_owner(_link(one)), only_owner(None):
        pass
    with only_owner(_link(one)):
        pass


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may start a program as another user")
def test_of_another_user_too() -> None:
    address = f"udpin://127.0.0.1:{free_port()}"
    with (
        _held(address, uid=NOBODY),
        pytest.raises(UnavailableError, match="another flockd has the link"),
        only_owner(_link(address)),
    ):
        pytest.fail("two own it")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("udpin://127.0.0.1:{port}", "udpin://0.0.0.0:{port}"),
        ("serial://{folder}/ttyACM0:57600", "serial://{folder}/by-id:921600"),
        ("tcpout://10.0.0.7:{port}", "tcpout://10.0.0.7:{port}"),
    ],
)
def test_under_another_name_it_is_the_same_link(one: str, other: str, tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to("ttyACM0")
    known = {"port": free_port(), "folder": tmp_path}
    with (
        only_owner(_link(one.format(**known))),
        pytest.raises(UnavailableError, match="another flockd has the link"),
        only_owner(_link(other.format(**known))),
    ):
        pytest.fail("two own it")
