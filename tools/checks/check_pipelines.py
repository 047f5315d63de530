"""Check cameras behind GStreamer on this computer: rate, time stamps, and all that can go wrong, by its own elements.

python -m tools.checks.check_pipelines [/dev/video0]

Needs GStreamer (`sudo apt install gstreamer1.0-plugins-base gstreamer1.0-plugins-good`). With a device, that camera is
read through GStreamer too. Exit code 0, 1 a check failed. `tools/checks/check_device.py` runs the same checks beside
those of V4L2, in a virtual machine.
"""

from __future__ import annotations

import argparse
import sys

from tools.checks.device_check import pipelines
from tools.checks.device_check.findings import Check


def main() -> int:
    """Prints a line a check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("device", nargs="?", help="/dev/video0 or another")
    arguments = parser.parse_args()
    checks: list[Check] = list(pipelines.CHECKS)
    if arguments.device:
        checks.insert(1, lambda: pipelines.streams_a_camera(arguments.device))
    passed = True
    for check in checks:
        for finding in check():
            passed = passed and finding.passed
            print(f"{'PASS' if finding.passed else 'FAIL'}  {finding.check:28s} {finding.measured}", flush=True)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
