"""Tests that are coroutines: `async def test_...`, with fixtures and parameters as other tests have them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

Story = Callable[[], Coroutine[Any, Any, None]]


def run_coroutine_test(test: pytest.Function, run: Callable[[Story], None]) -> bool | None:
    """Runs it with ``run`` and gives True; None, as pytest's hook has it, for a test that is none."""
    if not inspect.iscoroutinefunction(test.obj):
        return None
    given = {name: test.funcargs[name] for name in inspect.signature(test.obj).parameters}
    run(lambda: test.obj(**given))
    return True
