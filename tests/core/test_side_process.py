"""A side process answers, raises what its work raised, and says how it ended."""

from __future__ import annotations

import operator
import os
import signal
import time
from functools import partial

import pytest

from flockd.core.errors import UnavailableError
from flockd.core.side_process import SideProcess


def test_it_raises_what_its_work_raised_with_the_place() -> None:
    with (
        SideProcess("divided", operator.methodcaller, "__floordiv__", 0) as helper,
        pytest.raises(ZeroDivisionError) as caught,
    ):
        helper.ask(1)
    assert "side_process.py" in caught.value.__notes__[0]


def test_one_that_was_killed_is_named_with_its_task() -> None:
    with SideProcess("flew drone1, drone3", operator.methodcaller, "bit_length") as process:
        assert process.ask(255) == 8
        os.kill(process.pid, signal.SIGKILL)
        with pytest.raises(UnavailableError) as caught:
            process.ask(255)
    assert str(caught.value) == (
        "the process that flew drone1, drone3 was ended by SIGKILL; if nobody ended it, free some memory, and try again"
    )


def test_one_that_hangs_is_named_with_its_task() -> None:
    with (
        SideProcess("flew drone2", partial, time.sleep, patience_s=2.0) as process,
        pytest.raises(UnavailableError) as caught,
    ):
        assert process.ask(0.0) is None
        process.ask(60.0)
    assert str(caught.value) == (
        "the process that flew drone2 has not answered for 2 s; try again, with less else for this computer to do"
    )
