"""A target that does all that flockd must not; each input's number says what."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from random import Random

from flockd.core.errors import FlockdError
from tools.checks.fuzzing.campaign import randomness
from tools.checks.fuzzing.target import Check, Target, own_errors

SEED = 7
FINE, OWN_ERROR, ANOTHER_ERROR, SPINS, SWALLOWS, DIES = range(6)


def _check(random: Random) -> None:
    drawn = random.random()
    number = next(n for n in range(6) if randomness(SEED, TARGET.name, n).random() == drawn)
    if number == OWN_ERROR:
        with own_errors():
            raise FlockdError("drone.yaml:3: name: is missing; write one")
    if number == ANOTHER_ERROR:
        raise KeyError("name")
    while number == SPINS:
        try:
            time.monotonic()
        except Exception:  # noqa: BLE001 - as careless code does
            continue
    if number == SWALLOWS:
        bytearray(1 << 30)
    if number == DIES:
        os.kill(os.getpid(), signal.SIGKILL)


def _prepare(folder: Path) -> Check:
    return _check


TARGET = Target("misbehaving", 1, _prepare)
