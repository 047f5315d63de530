"""flockd as a service: whether one runs already, and how much of the system its unit leaves open."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.ground.doctor.finding import Finding, failed, passed, warned

UNIT_FOLDERS = (Path("/etc/systemd/system"), Path("/usr/lib/systemd/system"), Path("/lib/systemd/system"))
UNIT = "flockd.service"
BAR, MUCH = 1.5, 5.0
"""Exposure scores, from 0 to 10. systemd itself calls 5 and more at best medium."""


def check_instance(taken: UnavailableError | None) -> Iterator[Finding]:
    """Whether another process owns the link to the autopilot: the error it is refused with."""
    if taken is None:
        yield passed("instance", "no other flockd on this computer has this drone's autopilot")
        return
    fix = "stop it while you examine (`systemctl stop flockd`), if the drone does not fly"
    yield failed("instance", str(taken).rpartition("; ")[0], fix)


def check_unit(unit: Path | None, folders: Sequence[Path] = UNIT_FOLDERS) -> Iterator[Finding]:
    """The security score of ``unit``; None: of the one installed in ``folders``, else of the one that flockd brings."""
    chosen, whose = (unit, "") if unit is not None else _find_unit(folders)
    if shutil.which("systemd-analyze") is None:
        measured = f"{chosen} was not checked, as systemd-analyze is not installed"
        yield warned("unit", measured, "examine where flockd is to run as a service")
        return
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(chosen)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    score = re.search(r"Overall exposure level for [^:]*: ([0-9.]+)", result.stdout)
    if score is None:
        reason = (result.stderr.strip().splitlines() or ["it said nothing"])[-1]
        yield failed("unit", f"{chosen} cannot be judged ({reason})", "install systemd/flockd.service anew")
        return
    yield judge_exposure(float(score[1]), chosen, whose)


def judge_exposure(score: float, unit: Path, whose: str) -> Finding:
    """0 is closed, 10 is open."""
    measured = f"{unit}{whose} exposes {score:.1f} of 10"
    fix = f"compare it and its drop-ins with systemd/{UNIT}; `systemd-analyze security` lists what is open"
    if score >= MUCH:
        return failed("unit", measured, fix)
    return warned("unit", f"{measured}, more than {BAR:g}", fix) if score > BAR else passed("unit", measured)


def _find_unit(folders: Sequence[Path]) -> tuple[Path, str]:
    for folder in folders:
        if (folder / UNIT).is_file():
            return folder / UNIT, ""
    return data_path("systemd") / UNIT, " (not installed)"
