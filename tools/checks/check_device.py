"""Check flockd on a real kernel and a real init: virtual cameras and systemd, in a virtual machine made for it.

sudo python3 -m tools.checks.check_device                              # from nothing; downloads about 300 MB
sudo python3 -m tools.checks.check_device --cache /var/cache/flockd    # keeps what it built for the next time
sudo python3 -m tools.checks.check_device --debian 13                  # on Debian 13 (trixie), with systemd 257
sudo python3 -m tools.checks.check_device --package                    # the Debian package: installed, upgraded,
removed

Needs Linux on x86-64 with qemu-system-x86, mmdebstrap and e2fsprogs, and no KVM: the processor is emulated. The machine
runs Debian 12 or 13 with its own kernel and systemd; flockd is installed by the lines of docs/real_drone.md, and its
unit runs `flockd run` with the shipped networks. The autopilot is flockd's fake; as an emulated processor is slow, the
images are small and the steps far apart. The machine's clock counts instructions, a nanosecond each: how busy this
computer is changes how long the check takes, and nothing of what it measures. --package installs half a gigabyte three
times.

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
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools.release import deb
from tools.release.wheels import LOCK, ROOT, copy_sources, download, download_locked

PROGRAMS = {"qemu-system-x86_64": "qemu-system-x86", "mmdebstrap": "mmdebstrap", "mkfs.ext4": "e2fsprogs"}
"""And the Debian package of each."""
PACKAGES = (
    *("systemd-sysv", "udev", "dbus", "kmod", "sudo", "iproute2", "python3", "python3-venv", "v4l-utils"),
    *("linux-image-amd64", "linux-headers-amd64", "v4l2loopback-dkms", "initramfs-tools", "zstd"),
    *("gstreamer1.0-plugins-base", "gstreamer1.0-plugins-good", "gstreamer1.0-tools", "gstreamer1.0-plugins-base-apps"),
)
SUITES = {"12": "bookworm", "13": "trixie"}
"""By Debian's version: its name at Debian."""
BOOT_MODULES = ("virtio_pci", "virtio_blk", "ext4")
PAGE, SECTION = ROOT / "docs" / "real_drone.md", "## Install it as a service"
DRONE_FILE = "my_drone.yaml"
"""What the page calls the file that its reader has written."""
FAKE_AUTOPILOT = "pymavlink>=2.4.40"
COMPILE = "import flockd.sim.autopilot.fake_autopilot"
"""What it needs of a dozen MAVLink dialects, and no more."""
ARCH = "amd64"
VERSIONS = ("1", "2")
"""Versions of the package, before and after it is upgraded."""
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
    """Builds, boots, listens, and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, metavar="DIR", help="keep the machine's files here, and use those there")
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        metavar="GROUP",
        help="of capture, pipelines, sandbox, bench and service",
    )
    parser.add_argument("--debian", choices=tuple(SUITES), default="12", help="what boots; default: %(default)s")
    parser.add_argument("--package", action="store_true", help="check the Debian package, and that alone")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    try:
        _need_all()
        signal.signal(signal.SIGTERM, _end)
        with _folder(arguments.cache, arguments.debian) as folder:
            part = _package(arguments.debian) if arguments.package else _by_hand(arguments.only)
            return _check(folder, arguments.debian, part, as_json=arguments.json)
    except (UnavailableError, deb.UnavailableError) as error:
        print(f"check_device: {error}", file=sys.stderr)
        return UNAVAILABLE


@dataclass(frozen=True)
class Part:
    """What is checked."""

    install: Callable[[Path, Path], None]
    """Makes the machine's files ready, with a folder of wheels."""
    share: Callable[[Path, Path], str]
    """Puts what the checks need into a folder that the machine sees, likewise; their command."""


def _check(folder: Path, debian: str, part: Part, *, as_json: bool) -> int:
    begun_s = time.monotonic()
    rows: list[dict[str, Any]] = []
    image, wheels = _build(folder, debian, part)
    for line in _run(folder, image, wheels, part):
        if "check" in line:
            rows.append(line)
            if not as_json:
                print(_row(line), flush=True)
        elif "group" in line:
            _note(f"{line['group']}: {line['took_s']} s of the machine's time")
    failed = [row for row in rows if not row["passed"]]
    wall_s = time.monotonic() - begun_s
    if as_json:
        print(json.dumps({"passed": not failed, "wall_s": round(wall_s, 1), "checks": rows}, indent=1))
    else:
        print(f"{len(rows) - len(failed)} of {len(rows)} passed, in {wall_s:.0f} s")
    return FAILED if failed else DONE


def _need_all() -> None:
    """Raises UnavailableError unless everything is there."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        raise UnavailableError("builds a machine for x86-64 and needs Linux on one")
    missing = sorted({package for program, package in PROGRAMS.items() if shutil.which(program) is None})
    if missing:
        raise UnavailableError(f"{', '.join(missing)} is not installed; `sudo apt install {' '.join(missing)}`")
    if os.geteuid() != 0:
        raise UnavailableError("the files of a Debian belong to root, who must run this; begin the command with sudo")


@contextmanager
def _folder(cache: Path | None, debian: str) -> Iterator[Path]:
    """Where the machine's files are."""
    if cache is not None:
        kept = cache / f"debian{debian}"
        kept.mkdir(parents=True, exist_ok=True)
        yield kept.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="flockd-device-", dir="/var/tmp") as folder:
        yield Path(folder)


def _documented_lines() -> tuple[str, str]:
    """What docs/real_drone.md says to install flockd as a service, and to start it."""
    _, _, section = PAGE.read_text(encoding="utf-8").partition(SECTION)
    blocks: list[str] = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    return blocks[0], blocks[1]


def _by_hand(groups: list[str]) -> Part:
    """flockd installed by the documentation's lines; all groups of checks, or these."""
    install, start = _documented_lines()

    def share(shared: Path, _wheels: Path) -> str:
        (shared / "start.sh").write_text(start, encoding="utf-8")
        return " ".join(
            ["/opt/flockd/bin/python -m tools.checks.device_check.guest /mnt/findings/lines start.sh", *groups]
        )

    return Part(lambda system, wheels: _install(system, wheels, install), share)


def _package(debian: str) -> Part:
    """The Debian package in two versions, on a Debian without flockd."""

    def share(shared: Path, wheels: Path) -> str:
        _note("building the package in two versions")
        files = [deb.build(shared, ARCH, f"debian{debian}", version, shelf=wheels, level=1) for version in VERSIONS]
        paths = (f"/mnt/check/{file.name}" for file in files)
        return " ".join(["python3 -m tools.checks.device_check.package /mnt/findings/lines", *paths])

    return Part(_install_fake_autopilot, share)


def _build(folder: Path, debian: str, part: Part) -> tuple[Path, Path]:
    """The machine's disk, and the wheels for it. Raises UnavailableError when something cannot be fetched."""
    system = folder / "system"
    with ThreadPoolExecutor(1) as aside:
        wheels = aside.submit(_wheels, folder, debian)
        if not (folder / "system.done").exists():
            _note("building a Debian")
            shutil.rmtree(system, ignore_errors=True)
            _debian(system, debian)
            (folder / "system.done").touch()
        _note("installing")
        _empty(system)
        part.install(system, wheels.result())
    _note("writing the disk")
    image = folder / "disk.img"
    image.unlink(missing_ok=True)
    _command("mkfs.ext4", "-q", "-O", "^has_journal", "-d", str(system), str(image), f"{IMAGE_MB}M")
    return image, wheels.result()


def _debian(system: Path, debian: str) -> None:
    """A tree of files, with a kernel that has the virtual cameras."""
    listed = r"\n".join(BOOT_MODULES)
    few_modules = (
        'mkdir -p "$1/etc/initramfs-tools/conf.d" && echo MODULES=list > "$1/etc/initramfs-tools/conf.d/check" && '
        f'printf "{listed}\\n" > "$1/etc/initramfs-tools/modules"'
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
    with tempfile.TemporaryDirectory(dir=folder) as fresh:
        try:
            download_locked(Path(fresh), machine=machine, python=python)
            download(Path(fresh), [FAKE_AUTOPILOT], machine=machine, python=python)
        except subprocess.CalledProcessError as error:
            raise UnavailableError("pip could not download the wheels; what it printed stands above") from error
        Path(fresh).rename(wheels)
        Path(fresh).mkdir()
    return wheels


def _empty(system: Path) -> None:
    """A Debian without flockd that runs the checks when it starts."""
    for old in ("opt/flockd", "opt/fake-autopilot", "etc/flockd", "srv/flockd", "srv/wheels"):
        shutil.rmtree(system / old, ignore_errors=True)
    for old in ("usr/lib/sysusers.d/flockd.conf", "etc/systemd/system/flockd.service"):
        (system / old).unlink(missing_ok=True)
    (system / "etc/fstab").write_text(FSTAB, encoding="utf-8")
    (system / "etc/hostname").write_text("drone\n", encoding="utf-8")
    (system / "etc/hosts").write_text("127.0.0.1 localhost drone\n", encoding="utf-8")
    (system / "etc/pip.conf").write_text("[global]\nno-index = true\nfind-links = /srv/wheels\n", encoding="utf-8")
    (system / "etc/systemd/system/device-check.service").write_text(UNIT, encoding="utf-8")
    wanted = system / "etc/systemd/system/multi-user.target.wants/device-check.service"
    wanted.unlink(missing_ok=True)
    wanted.symlink_to("../device-check.service")


def _install(system: Path, wheels: Path, install: str) -> None:
    """Runs the documentation's lines in the machine's files, as on a drone, but for where pip finds its packages."""
    source, shelf = system / "srv/flockd", system / "srv/wheels"
    source.mkdir(0o700, parents=True)  # what is installed must not need it: the service cannot read it
    copy_sources(source)
    shutil.copy(ROOT / "tools/checks/device_check/drone.yaml", source / DRONE_FILE)
    shutil.copytree(wheels, shelf)
    _inside(system, f"cd /{source.relative_to(system)}\n{install}")
    install = f"pip install --quiet --no-compile --target /opt/fake-autopilot '{FAKE_AUTOPILOT}'"
    _inside(system, f"/opt/flockd/bin/{install}\nPYTHONPATH=/opt/fake-autopilot /opt/flockd/bin/python -c '{COMPILE}'")
    shutil.rmtree(shelf)


def _install_fake_autopilot(system: Path, wheels: Path) -> None:
    """What it needs beyond flockd."""
    shelf = system / "srv/wheels"
    shutil.copytree(wheels, shelf)
    install = f"pip install --quiet --no-compile --target /opt/fake-autopilot '{FAKE_AUTOPILOT}'"
    _inside(system, f"python3 -m venv /srv/pip\n/srv/pip/bin/{install}\nrm -r /srv/pip")
    shutil.rmtree(shelf)


def _inside(system: Path, lines: str) -> None:
    """In a clean environment: this computer's settings for pip are not the machine's."""
    _command("chroot", str(system), "env", "-i", f"PATH={SYSTEM_PATH}", "HOME=/root", "bash", "-ec", lines)


def _run(folder: Path, image: Path, wheels: Path, part: Part) -> Iterator[dict[str, Any]]:
    """Boots, and gives what the machine writes down, line by line, until it has switched itself off."""
    shared, findings = folder / "check", folder / "findings"
    for fresh in (shared, findings):
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir()
    shutil.copytree(ROOT / "tools/checks/device_check", shared / "tools/checks/device_check")
    (shared / "check.sh").write_text(f"exec {part.share(shared, wheels)}\n", encoding="utf-8")
    _note("booting")
    machine = subprocess.Popen(_qemu(folder, image, shared, findings), stdin=subprocess.DEVNULL)
    try:
        yield from _lines(findings / "lines", machine)
    finally:
        machine.kill()
        machine.wait()


def _qemu(folder: Path, image: Path, shared: Path, findings: Path) -> list[str]:
    boot = folder / "system/boot"
    return [
        "qemu-system-x86_64", "-nodefaults", "-no-reboot", "-display", "none", "-m", str(MEMORY_MB),
        "-machine", "pc,accel=tcg", "-cpu", "Nehalem", "-icount", "shift=0,sleep=off", "-rtc", "clock=vm",
        "-kernel", str(next(boot.glob("vmlinuz-*"))), "-initrd", str(next(boot.glob("initrd.img-*"))),
        "-append", "root=/dev/vda rw console=ttyS0 quiet",
        "-drive", f"file={image},format=raw,if=virtio,snapshot=on",
        "-virtfs", f"local,path={shared},mount_tag=check,security_model=none,readonly=on",
        "-virtfs", f"local,path={findings},mount_tag=findings,security_model=none",
        "-serial", f"file:{folder / 'console.log'}",
    ]  # fmt: skip


def _lines(file: Path, machine: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    """As they come; a machine that ends without its last word is a failed check."""
    begun_s, read, line = time.monotonic(), 0, dict[str, Any]()
    while "done" not in line:
        over = machine.poll() is not None or time.monotonic() - begun_s > PATIENCE_S
        whole = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        for text in whole[read:]:
            line = json.loads(text)
            yield line
        read = len(whole)
        if over and "done" not in line:
            console = (file.parent.parent / "console.log").read_text(encoding="utf-8", errors="replace")
            print(console[-4000:], file=sys.stderr)
            what = "ended or hung before all checks were done; the end of its console stands above"
            yield {"check": "the machine", "passed": False, "measured": what, "wanted": "to run to its end"}
            return
        time.sleep(0.5)


def _row(line: dict[str, Any]) -> str:
    verdict = "PASS" if line["passed"] else "FAIL"
    row = f" (row {line['row']} of the faults)" if line.get("row") else ""
    return f"{verdict}  {line['check']:32s} {line['measured']}  (wanted: {line['wanted']}){row}"


def _command(*command: str) -> None:
    """Raises UnavailableError with the end of what a command that failed has printed."""
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=_environment())
    if result.returncode:
        output = (result.stdout + result.stderr).strip().splitlines()[-3:]
        raise UnavailableError(f"{Path(command[0]).name} failed ({'; '.join(output)})")


def _environment() -> dict[str, str]:
    return {**os.environ, "PATH": f"{SYSTEM_PATH}:{os.environ.get('PATH', '')}", "LC_ALL": "C"}


def _end(number: int, _frame: object) -> None:
    """On SIGTERM: takes the virtual machine with it."""
    sys.exit(128 + number)


def _note(what: str) -> None:
    """For whoever waits."""
    print(f"[{time.strftime('%H:%M:%S')}] {what}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
