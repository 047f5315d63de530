"""Runs all checks inside the virtual machine; `tools/checks/check_device.py` starts it there and reads what it writes.

python -m tools.checks.device_check.guest FINDINGS START [GROUP...]
"""

from __future__ import annotations

import sys
from pathlib import Path

from tools.checks.device_check import cameras, capture
from tools.checks.device_check.findings import Check, run_checks
from tools.checks.device_check.service import Service


def main() -> None:
    """All groups in their order; ``START``: the documentation's lines that start the unit."""
    findings, start, *only = sys.argv[1:]
    cameras.load()
    service = Service(Path(start).read_text(encoding="utf-8"))
    groups: dict[str, tuple[Check, ...]] = {"capture": capture.CHECKS, "service": service.checks}
    run_checks(Path(findings), [check for group in only or groups for check in groups[group]])
    service.close()


if __name__ == "__main__":
    main()
