"""Sources that end with their test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.onboard.sources.watched import Watch, WatchedSource


@pytest.fixture
def watch() -> Iterator[Watch]:
    """See `Watch`."""
    with ExitStack() as ending:

        def begin(*arguments: Any, **options: Any) -> WatchedSource:
            source = WatchedSource(*arguments, **options)
            ending.callback(source.stop)
            source.start()
            return source

        yield begin
