"""Runs all checks inside the virtual machine; `tools/checks/check_device.py` starts it there and reads what it writes.

python -m tools.checks.device_check.guest FINDINGS START [GROUP...]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from tools.checks.device_check import bench, cameras, capture, pipelines, sandbox
from tools.checks.device_check.findings import Check, Finding, Notebook
from tools.checks.device_check.service import Service


def main() -> None:
    """All groups in their order."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("findings", type=Path)
    parser.add_argument("start", type=Path, help="the documentation's lines that start the unit")
    parser.add_argument("groups", nargs="*")
    arguments = parser.parse_args()
    notebook = Notebook(arguments.findings, arguments.groups)
    cameras.load()
    service = Service(arguments.start.read_text(encoding="utf-8"))

    def bench_runs() -> Iterator[Finding]:
        return bench.runs(service)

    groups: dict[str, tuple[Check, ...]] = {
        "capture": (
            capture.streams,
            capture.carries_yuyv,
            capture.carries_mjpeg,
            capture.loses_frames,
            capture.flags_damage,
            capture.breaks,
            capture.falls_silent,
            capture.is_taken,
        ),
        "pipelines": (lambda: pipelines.streams_a_camera(cameras.WEBCAM), *pipelines.CHECKS),
        "bench": (bench_runs,),
        "sandbox": (sandbox.holds,),
        "service": (
            service.is_installed,
            service.starts,
            service.runs,
            service.flies,
            service.is_asked_to_reload,
            service.hangs,
            service.runs_out_of_memory,
            service.stops,
        ),
    }
    for group, checks in groups.items():
        notebook.run(group, checks)
    service.close()
    notebook.close()


if __name__ == "__main__":
    main()
