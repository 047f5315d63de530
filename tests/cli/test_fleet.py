"""`flockd fleet` without any drone; with drones it is flown in tests/onboard/daemon."""

from __future__ import annotations

from typing import Self

import pytest

from flockd.cli import main


class _Silence:
    """No drone is heard."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def drones(self) -> tuple[str, ...]:
        return ()


@pytest.mark.parametrize(
    ("drones", "told"),
    [("all", "no drone was"), ("drone1", "drone1 was not"), ("drone1,drone2", "drone1 and drone2 were not")],
)
def test_a_drone_that_is_not_heard_gets_no_request(
    drones: str, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("flockd.fleet.watcher.FleetWatcher", _Silence)
    monkeypatch.setattr("flockd.cli.fleet.FIND_S", 0.0)
    assert main(["fleet", "hold", drones, "--connect", "tcp/127.0.0.1:1"]) == 69
    sentence = f"{told} found at tcp/127.0.0.1:1; no request was sent; check `flockd status`\n"
    assert capsys.readouterr().err == sentence
