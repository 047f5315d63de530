"""`flockd fleet` without a command: what it refuses, and the address that it prints."""

from __future__ import annotations

import socket
from argparse import Namespace

import pytest

from flockd.cli import main
from flockd.cli.fleet import announce


def test_a_taken_port_is_reported_in_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["fleet", "--connect", "tcp/127.0.0.1:1", "--port", str(port)]) == 69
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(f"the page cannot use 127.0.0.1 port {port} (")
    assert error.endswith("); name others")


@pytest.mark.parametrize(
    ("address", "shown", "warns"),
    [
        ("127.0.0.1", "127.0.0.1", False),
        ("::1", "[::1]", False),
        ("0.0.0.0", "127.0.0.1", True),
        ("10.0.0.7", "10.0.0.7", True),
    ],
)
def test_an_address_that_others_reach_comes_with_a_warning(
    address: str, shown: str, warns: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    args = Namespace(server_address=address, connect=["tcp/127.0.0.1:1"], drones_at=None)
    announce(args, 80, "k")
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == f"the fleet page is at http://{shown}:80/?key=k"
    assert ("travels unencrypted" in err) == ("on other computers" in out) == warns
