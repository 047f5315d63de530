"""Check flockd on a real kernel and a real init: virtual cameras and systemd, in a virtual machine made for it.

sudo python3 -m tools.checks.check_device                              # from nothing; downloads about 300 MB
sudo python3 -m tools.checks.check_device --cache /var/cache/flockd    # keeps what it built for the next time
sudo python3 -m tools.checks.check_device --debian 13                  # on Debian 13 (trixie), with systemd 257

Needs Linux on x86-64 with qemu-system-x86, mmdebstrap and e2fsprogs, and no KVM: the processor is emulated. The machine
runs Debian 12 or 13 with its own kernel and systemd; flockd is installed by the lines of docs/install.md, and its
unit runs `flockd run` with the shipped networks. The autopilot is flockd's fake; as an emulated processor is slow, the
images are small and the steps far apart. The machine's clock counts instructions, a nanosecond each: how busy this
computer is changes how long the check takes, and nothing of what it measures.

Exit code 0, 1 a check failed, 69 something needed is not there. A check that is a row of the list of faults
(`docs/reference/faults.md`) says which.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tools.release import deb
from tools.release.wheels import LOCK, ROOT, copy_sources, download, download_locked

PROGRAMS = {"qemu-system-x86_64": "qemu-system-x86", "mmdebstrap": "mmdebstrap", "mkfs.ext4": "e2fsprogs"}
"""And the Debian package of each."""
PACKAGES = (
    *("systemd-sysv", "udev", "dbus", "kmod", "sudo", "iproute2", "procps", "python3", "python3-venv"),
    *("linux-image-amd64", "linux-headers-amd64", "v4l2loopback-dkms", "initramfs-tools", "zstd"),
)
SUITES = {"12": "bookworm", "13": "trixie"}
"""By Debian's version: its name at Debian."""
BOOT_MODULES = ("virtio_pci", "virtio_blk", "ext4")
CHECKS = Path("tools/checks/device_check")
DRONE_FILE = "my_drone.yaml"
"""The drone's file in docs/install.md, which the reader writes."""
FAKE_AUTOPILOT = "pymavlink>=2.4.40"
PIP = f"pip install --quiet --no-compile --target /opt/fake-autopilot '{FAKE_AUTOPILOT}'"
COMPILE = "import flockd.sim.autopilot.fake_autopilot"
"""Compiles only the needed one of a dozen MAVLink dialects."""
ARCH = "amd64"
SYSTEM_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
IMAGE_MB, MEMORY_MB = 4096, 2048
PATIENCE_S = 3600.0
DONE, FAILED, UNAVAILABLE = 0, 1, 69
UNIT = """\
[Unit]
Description=flockd's device check
RequiresMountsFor=/mnt/check /mnt/findings
[Service]
Type=oneshot
WorkingDirectory=/mnt/check
Environment=PYTHONPATH=/opt/fake-autopilot PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1
ExecStart=sh check.sh
ExecStopPost=systemctl poweroff --no-block
StandardOutput=journal+console
StandardError=journal+console
[Install]
WantedBy=multi-user.target
"""
FSTAB = """\
/dev/vda / ext4 defaults 0 0
check /mnt/check 9p trans=virtio,version=9p2000.L,ro 0 0
findings /mnt/findings 9p trans=virtio,version=9p2000.L 0 0
"""


class UnavailableError(Exception):
    """Something needed is not there; the text says what."""


def main() -> int:
    """Build the machine, boot it, and print its findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, metavar="DIR", help="keep the machine's files here, and use those there")
    parser.add_argument("--debian", choices=tuple(SUITES), default="12", help="what boots; default: %(default)s")
    arguments = parser.parse_args()
    try:
        _need_all()
        signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))  # takes the machine with it
        if arguments.cache is not None:
            kept = (arguments.cache / f"debian{arguments.debian}").resolve()
            kept.mkdir(parents=True, exist_ok=True)
            return check(kept, arguments.debian)
        with tempfile.TemporaryDirectory(prefix="flockd-device-", dir="/var/tmp") as folder:
            return check(Path(folder), arguments.debian)
    except UnavailableError as error:
        print(f"check_device: {error}", file=sys.stderr)
        return UNAVAILABLE


def check(folder: Path, debian: str) -> int:
    """The exit code."""
    begun_s, passed, failed = time.monotonic(), 0, 0
    install, start = documented_lines()
    image = _build(folder, debian, install)
    shared = _fresh(folder / "check")
    shutil.copytree(ROOT / CHECKS, shared / CHECKS)
    (shared / "start.sh").write_text(start, encoding="utf-8")
    command = "exec /opt/flockd/bin/python -m tools.checks.device_check.service /mnt/findings/lines start.sh\n"
    (shared / "check.sh").write_text(command, encoding="utf-8")
    for line in _run(folder, image, shared):
        if "check" in line:
            passed, failed = passed + line["passed"], failed + (not line["passed"])
            row = f" (row {line['row']} of the faults)" if line.get("row") else ""
            verdict = "PASS" if line["passed"] else "FAIL"
            print(f"{verdict}  {line['check']:32s} {line['measured']}  (wanted: {line['wanted']}){row}", flush=True)
    print(f"{passed} of {passed + failed} passed, in {time.monotonic() - begun_s:.0f} s")
    return FAILED if failed else DONE


def documented_lines() -> tuple[str, str]:
    """The lines of docs/install.md that install flockd as a service, and those that start it."""
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    install, start = re.findall(r"```sh\n(.*?)```", page.partition("## Install it as a service")[2], re.DOTALL)[:2]
    return install, start


def _need_all() -> None:
    """Raises UnavailableError unless everything is there."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        raise UnavailableError("builds a machine for x86-64 and needs Linux on one")
    missing = sorted({package for program, package in PROGRAMS.items() if shutil.which(program) is None})
    if missing:
        raise UnavailableError(f"{', '.join(missing)} is not installed; `sudo apt install {' '.join(missing)}`")
    if os.geteuid() != 0:
        raise UnavailableError("the files of a Debian belong to root, who must run this; begin the command with sudo")


def _build(folder: Path, debian: str, install: str) -> Path:
    """The machine's disk, with flockd installed by these lines. Raises UnavailableError."""
    system, wheels = folder / "system", _wheels(folder, debian)
    if not (folder / "system.done").exists():
        _note("building a Debian")
        _debian(_fresh(system), debian)
        (folder / "system.done").touch()
    _note("installing")
    _empty(system)
    shelf = system / "srv/wheels"
    shutil.copytree(wheels, shelf)
    source = system / "srv/flockd"
    source.mkdir(0o700)  # what is installed must not need it: the service cannot read it
    copy_sources(source)
    shutil.copy(ROOT / CHECKS / "drone.yaml", source / DRONE_FILE)
    _inside(system, f"cd /srv/flockd\n{install}")
    _inside(system, f"/opt/flockd/bin/{PIP}\nPYTHONPATH=/opt/fake-autopilot /opt/flockd/bin/python -c '{COMPILE}'")
    shutil.rmtree(shelf)
    _note("writing the disk")
    image = folder / "disk.img"
    image.unlink(missing_ok=True)
    _command("mkfs.ext4", "-q", "-O", "^has_journal", "-d", str(system), str(image), f"{IMAGE_MB}M")
    return image


def _debian(system: Path, debian: str) -> None:
    """A tree of files, with a kernel that has the virtual cameras."""
    few_modules = (
        'mkdir -p "$1/etc/initramfs-tools/conf.d" && echo MODULES=list > "$1/etc/initramfs-tools/conf.d/check" && '
        f'printf "%s\\n" {" ".join(BOOT_MODULES)} > "$1/etc/initramfs-tools/modules"'
    )
    without = [f"--dpkgopt=path-exclude=/usr/share/{what}/*" for what in ("doc", "man", "locale", "info")]
    _command(
        "mmdebstrap", "--quiet", "--variant=apt", f"--include={','.join(PACKAGES)}", "--dpkgopt=force-unsafe-io",
        *without, f"--essential-hook={few_modules}", SUITES[debian], str(system),
    )  # fmt: skip


def _wheels(folder: Path, debian: str) -> Path:
    """What the lock names and the fake autopilot needs, from the package index, for the machine's Python."""
    wheels = folder / f"wheels-{hashlib.sha256(LOCK.read_bytes() + FAKE_AUTOPILOT.encode()).hexdigest()[:8]}"
    if wheels.exists():
        return wheels
    machine, python = deb.MACHINES[ARCH], deb.SYSTEMS[f"debian{debian}"].python
    fresh = _fresh(folder / "wheels-coming")
    try:
        download_locked(fresh, machine=machine, python=python)
        download(fresh, [FAKE_AUTOPILOT], machine=machine, python=python)
    except subprocess.CalledProcessError as error:
        raise UnavailableError("pip could not download the wheels; what it printed stands above") from error
    return fresh.rename(wheels)


def _empty(system: Path) -> None:
    """A Debian without flockd that runs the checks when it starts."""
    for old in ("opt/flockd", "opt/fake-autopilot", "etc/flockd", "srv/flockd", "srv/wheels"):
        shutil.rmtree(system / old, ignore_errors=True)
    wanted = "etc/systemd/system/multi-user.target.wants/device-check.service"
    for old in ("usr/lib/sysusers.d/flockd.conf", "etc/systemd/system/flockd.service", wanted):
        (system / old).unlink(missing_ok=True)
    for name, text in {
        "etc/fstab": FSTAB,
        "etc/hostname": "drone\n",
        "etc/hosts": "127.0.0.1 localhost drone\n",
        "etc/pip.conf": "[global]\nno-index = true\nfind-links = /srv/wheels\n",
        "etc/systemd/system/device-check.service": UNIT,
    }.items():
        (system / name).write_text(text, encoding="utf-8")
    (system / wanted).symlink_to("../device-check.service")


def _inside(system: Path, lines: str) -> None:
    """Run lines of a shell in the system, without this computer's environment and settings for pip."""
    _command("chroot", str(system), "env", "-i", f"PATH={SYSTEM_PATH}", "HOME=/root", "bash", "-ec", lines)


def _run(folder: Path, image: Path, shared: Path) -> Iterator[dict[str, Any]]:
    """Boot the machine and yield the lines that it writes; if it ends without the last one, a failed check."""
    boot, findings, console = folder / "system/boot", _fresh(folder / "findings"), folder / "console.log"
    _note("booting")
    command = [
        "qemu-system-x86_64", "-nodefaults", "-no-reboot", "-display", "none", "-m", str(MEMORY_MB),
        "-machine", "pc,accel=tcg", "-cpu", "Nehalem", "-icount", "shift=0,sleep=off", "-rtc", "clock=vm",
        "-kernel", str(next(boot.glob("vmlinuz-*"))), "-initrd", str(next(boot.glob("initrd.img-*"))),
        "-append", "root=/dev/vda rw console=ttyS0 quiet",
        "-drive", f"file={image},format=raw,if=virtio,snapshot=on",
        "-virtfs", f"local,path={shared},mount_tag=check,security_model=none,readonly=on",
        "-virtfs", f"local,path={findings},mount_tag=findings,security_model=none",
        "-serial", f"file:{console}",
    ]  # fmt: skip
    machine = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    begun_s, read, line = time.monotonic(), 0, dict[str, Any]()
    try:
        while "done" not in line:
            over = machine.poll() is not None or time.monotonic() - begun_s > PATIENCE_S
            file = findings / "lines"
            whole = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
            for text in whole[read:]:
                line = json.loads(text)
                yield line
            read = len(whole)
            if over and "done" not in line:
                print(console.read_text(encoding="utf-8", errors="replace")[-4000:], file=sys.stderr)
                what = "ended or hung before all checks were done; the end of its console stands above"
                yield {"check": "the machine", "passed": False, "measured": what, "wanted": "to run to its end"}
                return
            time.sleep(0.5)
    finally:
        machine.kill()
        machine.wait()


def _fresh(folder: Path) -> Path:
    """Make an empty folder in place of the old one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _command(*command: str) -> None:
    """Raises UnavailableError with the end of what a command that failed has printed."""
    environment = {**os.environ, "PATH": f"{SYSTEM_PATH}:{os.environ.get('PATH', '')}", "LC_ALL": "C"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if result.returncode:
        output = (result.stdout + result.stderr).strip().splitlines()[-3:]
        raise UnavailableError(f"{Path(command[0]).name} failed ({'; '.join(output)})")


def _note(what: str) -> None:
    """Print progress, with the time."""
    print(f"[{time.strftime('%H:%M:%S')}] {what}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
