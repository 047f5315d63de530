"""Fuzz every place where flockd reads what comes from outside, and what flies.

python -m tools.checks.fuzz                                  # 20,000 inputs over all targets, about a minute
python -m tools.checks.fuzz --count 1000000
python -m tools.checks.fuzz --only manifests --only gate --seed 3
python -m tools.checks.fuzz --only manifests --seed 3 --first 1234 --count 1   # one input again

Inputs are valid ones (config/, models/, tools/checks/fuzzing/corpus/, or made up) changed where it hurts most: lines,
JSON values, records behind correct checksums, bytes. Each is made of the seed, the target's name and its number alone.
A finding is an error that is not one of flockd's own, a text that no terminal should get, a process that ends, an input
that takes 5 s, memory over 1 GiB, or a command or setpoint that is not finite or outside the limits. Exit code 1 if
there is one.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from typing import Any

from tools.checks.fuzzing.campaign import Result, run
from tools.checks.fuzzing.table import TARGETS


def shares(names: list[str], count: int) -> dict[str, int]:
    """How many inputs each target gets; at least one."""
    total = sum(TARGETS[name].share for name in names)
    return {name: max(round(count * TARGETS[name].share / total), 1) for name in names}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000, help="inputs over all targets (default: 20000)")
    parser.add_argument("--only", action="append", choices=sorted(TARGETS), help="a target; may be given again")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--first", type=int, default=0, help="number of the first input (default: 0)")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    args = parser.parse_args()
    results = []
    for name, count in shares(args.only or list(TARGETS), args.count).items():
        results.append(run(TARGETS[name], args.seed, args.first, count))
        if not args.json:
            _say(results[-1], args.seed)
    if args.json:
        print(json.dumps([_plain(result) for result in results], indent=1))
    else:
        total, found = sum(result.inputs for result in results), sum(len(result.findings) for result in results)
        print(f"{total} inputs, {found} findings")
    return 1 if any(result.findings for result in results) else 0


def _say(result: Result, seed: int) -> None:
    rate = result.inputs / max(result.seconds, 1e-3)
    print(
        f"{result.target:16}{result.inputs:9} inputs {result.seconds:7.0f} s {rate:8.0f}/s "
        f"memory +{result.grown_mb:.0f} MB, {len(result.findings)} findings",
        flush=True,
    )
    for finding in result.findings.values():
        again = (
            f"python -m tools.checks.fuzz --only {finding.target} --seed {seed} --first {finding.inputs[0]} --count 1"
        )
        print(f"  {finding.count} x {finding.what}\n    {again}", flush=True)


def _plain(result: Result) -> dict[str, Any]:
    return {**asdict(result), "findings": [asdict(finding) for finding in result.findings.values()]}


if __name__ == "__main__":
    sys.exit(main())
