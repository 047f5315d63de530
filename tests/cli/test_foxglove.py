"""`flockd foxglove`: what it refuses, and the address that it prints."""

from __future__ import annotations

import socket
import sys

import pytest

from flockd.cli import installing, main


def test_without_its_extra_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "foxglove"]:
        monkeypatch.delitem(sys.modules, name)
    for name in [name for name in sys.modules if name.startswith("flockd.fleet.foxglove.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    assert main(["foxglove", "--recordings", "nowhere"]) == 69
    assert capsys.readouterr().err == f"foxglove is not installed; run: {installing('foxglove')}\n"


def test_a_taken_port_is_reported_in_one_sentence() -> None:
    from flockd.core.errors import UnavailableError
    from flockd.fleet.foxglove.server import FoxgloveServer

    class Nothing:
        span_s = None

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UnavailableError) as refused:
            FoxgloveServer(Nothing(), "127.0.0.1", port)  # type: ignore[arg-type]
    assert str(refused.value).startswith(f"the server cannot use 127.0.0.1 port {port} (Address already in use")
    assert str(refused.value).endswith("); name others")
