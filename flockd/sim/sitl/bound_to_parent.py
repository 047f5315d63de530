"""Runs a program that ends when the process that started it does, however that ends: SIGKILL too.

python -m flockd.sim.sitl.bound_to_parent PARENT COMMAND [ARGUMENT...]

Linux sends SIGTERM when the thread that started it ends (PR_SET_PDEATHSIG of prctl(2)), also after the command has
taken this process's place.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path

import flockd

PR_SET_PDEATHSIG = 1
_MODULE = "flockd.sim.sitl.bound_to_parent"


def bound(command: list[str]) -> list[str]:
    """The command that runs ``command`` bound to this process; its environment has to find this package."""
    return [sys.executable, "-m", _MODULE, f"{os.getpid()}", *command]


def bind(parent: int) -> None:
    """Binds this process to the one that started it. Exits where that has ended already."""
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "the parent's end cannot be watched")
    if os.getppid() != parent:
        sys.exit(128 + signal.SIGTERM)


def with_package(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment, in which Python finds this package wherever it runs."""
    package, known = str(Path(flockd.__file__).parents[1]), environment.get("PYTHONPATH")
    if known and package in known.split(os.pathsep):
        return dict(environment)
    return {**environment, "PYTHONPATH": f"{package}{os.pathsep}{known}" if known else package}


def main() -> None:
    """Becomes the command. Exits where the parent has ended already."""
    parent, command = int(sys.argv[1]), sys.argv[2:]
    bind(parent)
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
