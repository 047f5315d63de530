"""Coroutines of this folder's tests run on the clock that drone, fake autopilot and test share."""

from __future__ import annotations

import pytest

from tests import calm


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """See `tests.calm`."""
    return calm.run_coroutine_test(pyfuncitem, calm.run)
