"""The only tests that may skip, why, and how to run them. `tests/conftest.py` fails every other skip.

What `make test` installs is no reason to skip. An entry is for hardware, data, system tools or rights that a build
machine need not have.
"""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase


@dataclass(frozen=True)
class PermittedSkip:
    """Tests that may skip for one reason."""

    tests: str
    """Shell pattern of their ids, such as `tests/onboard/daemon/*`."""
    reason: str
    """Contained in what the test gives as its reason."""
    to_run: str
    """What a person has to do for them to run."""


PERMITTED = (
    PermittedSkip("tests/sitl/*", "FLOCKD_PX4 names no", "build PX4 SITL and name its build folder in FLOCKD_PX4"),
    PermittedSkip(
        "tests/ground/datasets/*",
        "FLOCKD_DATA does not name",
        "name in FLOCKD_DATA a folder that holds hololens/",
    ),
    PermittedSkip(
        "tests/flight/inference/*",
        "this computer can compute with CUDA",
        "install onnxruntime in place of onnxruntime-gpu",
    ),
    PermittedSkip("tests/cli/*", "this computer has TensorRT", "install onnxruntime in place of onnxruntime-gpu"),
    PermittedSkip(
        "tests/onboard/recording/*",
        "a small file system cannot be mounted",
        "run as root, where `mount -t tmpfs` is allowed",
    ),
    PermittedSkip("tests/*/d*", "systemd-analyze is not here", "install systemd (tests of units in daemon and doctor)"),
    PermittedSkip("tests/review/report/*", "chromium is not here", "install chromium"),
    PermittedSkip("tests/onboard/telemetry/*", "openssl is not here", "install the openssl command"),
)


def permitted(test: str, reason: str) -> PermittedSkip | None:
    """The entry that lets this test skip for this reason."""
    for entry in PERMITTED:
        if fnmatchcase(test, entry.tests) and entry.reason in reason:
            return entry
    return None
