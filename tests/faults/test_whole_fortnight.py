"""All flights of a fortnight with one drone, by hand: `make flights`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.test_fortnight import fly_a_fortnight


@pytest.mark.slow
@pytest.mark.whole_flight
async def test_forty_flights(tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten in each life of the service."""
    await fly_a_fortnight(4, 10, tmp_path, port, monkeypatch.setattr)
