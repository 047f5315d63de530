"""What the check of a device relies on: the documented installation, and the file of its drone."""

from __future__ import annotations

import re
from pathlib import Path

from flockd.core.config import load_real_drone
from tools.checks.check_device import DRONE_FILE, documented_lines

ROOT = Path(__file__).parents[3]


def test_the_documentation_installs_what_the_unit_starts() -> None:
    """The check runs these lines; a drone's owner does so by hand."""
    install, start = documented_lines()
    unit = (ROOT / "systemd" / "flockd.service").read_text(encoding="utf-8")
    command = re.search(r"^ExecStart=(\S+)/bin/flockd run --config (\S+)", unit, re.MULTILINE)
    assert command is not None
    environment, config = command.groups()
    assert f"\npython3 -m venv {environment}\n" in install
    assert f"\n{environment}/bin/pip install --require-hashes -r requirements/service.txt\n" in install
    assert f"\n{environment}/bin/pip install --no-deps --no-build-isolation .\n" in install
    assert re.findall(r"sudo.*(?:pip|venv)", install) == [], "no code of a package runs as root"
    assert config in install
    assert start == "sudo systemctl enable --now flockd\n"
    for name in re.findall(r" ((?:config|systemd|requirements)/\S+)", install):
        assert (ROOT / name).is_file(), name
    written = [name for name in re.findall(r"sudo install -D? ?-m 644 (\S+)", install) if not (ROOT / name).is_file()]
    assert written == [DRONE_FILE], "what the reader has written, and the check brings"


def test_its_drone_can_be_flown() -> None:
    config, outside = load_real_drone(ROOT / "tools" / "checks" / "device_check" / "drone.yaml")
    assert not outside, "`flockd run` would refuse it"
    assert config.source is not None
    assert {camera.device for camera in config.source.cameras} == {"/dev/video10", "/dev/video20"}
