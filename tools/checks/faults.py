"""Inject every fault that a drone must survive, and print what became of each, and how quickly it was reacted to.

python -m tools.checks.faults                                    # all; takes about ten minutes, with PX4 twenty
python -m tools.checks.faults --only camera-unplugged sigterm
python -m tools.checks.faults --list
python -m tools.checks.faults --json

The list is `tests/faults/catalogue.py`. Stories that need PX4, root or systemd are skipped where there is none, with
the reason. Cameras and the service on a real kernel: `tools/checks/check_device.py`. Exit code 0, or 1: a fault was not
survived as it should be.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.faults.catalogue import CATALOGUE, REACTION, Fault

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 600.0
"""For the stories of one fault."""
DONE, FAILED, USAGE = 0, 1, 2

Result = Literal["pass", "fail", "skip"]


@dataclass(frozen=True)
class Outcome:
    """What became of one fault."""

    fault: Fault
    result: Result
    reaction_s: float | None
    """The slowest of its stories; None where none measured one."""
    why: str

    def row(self) -> dict[str, object]:
        """For JSON."""
        return {
            "name": self.fault.name,
            "row": self.fault.row,
            "result": self.result,
            "reaction_s": self.reaction_s,
            "why": self.why,
        }


def main() -> int:
    """Runs the stories and prints; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these faults")
    parser.add_argument("--list", action="store_true", help="print the catalogue and run nothing")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    known = {fault.name for fault in CATALOGUE}
    unknown = sorted(set(arguments.only or ()) - known)
    if unknown:
        print(f"faults: there is no fault {unknown[0]!r}; --list prints their names", file=sys.stderr)
        return USAGE
    chosen = [fault for fault in CATALOGUE if arguments.only is None or fault.name in arguments.only]
    if arguments.list:
        for fault in chosen:
            print(f"{fault.row:3d} {fault.name:28s} {fault.fault}: {fault.reaction}")
        return DONE
    outcomes = []
    for fault in chosen:
        outcomes.append(run(fault))
        if not arguments.json:
            print(_line(outcomes[-1]), flush=True)
    failed = [outcome for outcome in outcomes if outcome.result == "fail"]
    if arguments.json:
        print(json.dumps({"faults": [outcome.row() for outcome in outcomes]}, indent=1))
    else:
        counts = {what: sum(outcome.result == what for outcome in outcomes) for what in ("pass", "fail", "skip")}
        print(", ".join(f"{count} {what}" for what, count in counts.items()))
    return FAILED if failed else DONE


def run(fault: Fault) -> Outcome:
    """Runs the stories of one fault in a process of their own: a crash or a hang of one is its failure."""
    with tempfile.TemporaryDirectory(prefix="flockd-fault-") as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", f"--junitxml={report}", *fault.stories]
        try:
            ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        except subprocess.TimeoutExpired:
            return Outcome(fault, "fail", None, f"its stories did not end within {PATIENCE_S:.0f} s")
        if not report.exists():
            last = (ended.stdout + ended.stderr).strip().splitlines() or ["nothing was printed"]
            return Outcome(fault, "fail", None, f"pytest ended with exit code {ended.returncode}: {last[-1]}")
        return outcome(fault, ET.parse(report).getroot(), ended.returncode)


def outcome(fault: Fault, report: ET.Element, code: int) -> Outcome:
    """What pytest's report, as JUnit XML, says of the stories of a fault; ``code`` is pytest's exit code."""
    cases = list(report.iter("testcase"))
    failures = [(case, problem) for case in cases for tag in ("failure", "error") for problem in case.findall(tag)]
    skips = [skip.get("message", "") for case in cases for skip in case.findall("skipped")]
    wanted = f"{REACTION}{fault.name}"
    times = [float(found.get("value", "nan")) for found in report.iter("property") if found.get("name") == wanted]
    reaction_s = max(times, default=None)
    if failures:
        case, problem = failures[0]
        return Outcome(fault, "fail", reaction_s, f"{case.get('name')}: {_first_line(problem.get('message', ''))}")
    if code not in {0, 5} or not cases:
        return Outcome(fault, "fail", reaction_s, f"pytest ended with exit code {code}, {len(cases)} stories run")
    if len(skips) == len(cases):
        return Outcome(fault, "skip", None, skips[0])
    why = f"{len(skips)} of {len(cases)} stories skipped: {skips[0]}" if skips else ""
    return Outcome(fault, "pass", reaction_s, why)


def _first_line(text: str) -> str:
    return text.strip().splitlines()[0] if text.strip() else "no message"


def _line(found: Outcome) -> str:
    limit_s = found.fault.within_s
    measured = "" if found.reaction_s is None else f"{found.reaction_s:.2f} s"
    allowed = "" if limit_s is None else f"of {limit_s:g} s"
    return (
        f"{found.result.upper():4s} {found.fault.row:3d} {found.fault.name:28s} {measured:>8s} {allowed:8s} {found.why}"
    )


if __name__ == "__main__":
    sys.exit(main())
