"""Install the Debian package in a new system of its distribution and architecture, under emulation, and run it there.

python -m tools.release.check_emulated --system debian12                       # for arm64
python -m tools.release.check_emulated --system ubuntu24.04 --arch amd64 --mirror http://archive.ubuntu.com/ubuntu

A system is made from the distribution's mirror, the package is built and installed with apt, and in there flockd says
its version, checks the configuration of the package, gives its networks their golden inputs (`flockd doctor`), flies
the ten steps of a recorded flight again, as the service's user, to the numbers expected here, and goes without a trace.
systemd checks the unit.

Needs root, debootstrap, a package index, 3 GB in the folder for temporary files, and, for another architecture than
this computer's, QEMU's user emulation, which the kernel starts by itself (Debian: qemu-user-static). Exit code 69:
something of that is missing; 1: something of flockd failed, and is named.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from flockd import __version__
from tests.review.replay.test_regression import tolerances
from tools.checks.references import with_float_networks
from tools.release import deb
from tools.release.check_wheel import run
from tools.release.wheels import ROOT

FLIGHT = Path("tests/review/replay/normal.mcap")
DEBIAN, UBUNTU_PORTS = "http://deb.debian.org/debian", "http://ports.ubuntu.com/ubuntu-ports"


class Suite(NamedTuple):
    """What debootstrap makes a system of."""

    name: str
    mirror: str
    script: str
    """debootstrap's script: an older debootstrap lacks the suite's name, and all suites of a distribution share one."""
    keyring: str


DEBIANS, UBUNTUS = (f"/usr/share/keyrings/{name}-archive-keyring.gpg" for name in ("debian", "ubuntu"))
SUITES = {
    "debian12": Suite("bookworm", DEBIAN, "sid", DEBIANS),
    "debian13": Suite("trixie", DEBIAN, "sid", DEBIANS),
    "ubuntu24.04": Suite("noble", UBUNTU_PORTS, "gutsy", UBUNTUS),
}
BINFMT = Path("/proc/sys/fs/binfmt_misc")
"""The formats that the kernel starts by another program."""
INSTALL = "apt-get install --quiet --quiet --yes --no-install-recommends"
SIMULATOR = "/usr/lib/flockd/lib/python*/site-packages/flockd/_data/config/simulator.yaml"
NETWORKS = ("flow_int8", "neighbours_int8", "detector", "distance_int8", "verification_int8")
AGAIN = "flockd replay /tmp/flight.mcap --config /tmp/drone.yaml --diff --reference /tmp/flight.expected"
STEPS = (
    (f"apt-get update --quiet --quiet && {INSTALL} /tmp/*.deb", ()),
    ("flockd --version", (f"flockd {__version__}",)),
    ("flockd config check /etc/flockd/drone.yaml", ("/etc/flockd/drone.yaml: fine",)),
    # It fails steps that are too slow, as it should under emulation; of what is installed nothing may be wrong.
    (f"flockd doctor --config {SIMULATOR} || true", tuple(f"PASS     model {name}" for name in NETWORKS)),
    (
        f"runuser -u flockd -- {AGAIN} {' '.join(tolerances(FLIGHT.stem))}",
        ("drone1: 10 steps", "equal in all "),
    ),
    ("systemd-analyze verify /usr/lib/systemd/system/flockd.service", ()),
    ("apt-get purge --quiet --quiet --yes flockd && test ! -e /usr/lib/flockd && test ! -e /etc/flockd/drone.yaml", ()),
)
"""What is run in the system, and what it has to print."""


def main() -> int:
    """Run each step; the first failure ends the check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--system", required=True, choices=tuple(SUITES))
    parser.add_argument("--arch", default="arm64", choices=tuple(deb.MACHINES), help="default: %(default)s")
    parser.add_argument("--mirror", metavar="URL", help="of the distribution, instead of its own")
    args = parser.parse_args()
    suite = SUITES[args.system]
    if missing := _missing(args.arch, suite):
        print(f"check_emulated: {missing}", file=sys.stderr)
        return deb.UNAVAILABLE
    with tempfile.TemporaryDirectory(prefix="flockd-system-") as name:
        system = Path(name) / "system"
        options = ["--variant=minbase", f"--arch={args.arch}", f"--keyring={suite.keyring}"]
        run(["debootstrap", *options, suite.name, str(system), args.mirror or suite.mirror, suite.script], Path(name))
        deb.build(system / "tmp", args.arch, args.system, __version__, level=1)
        shutil.copy(ROOT / FLIGHT, system / "tmp/flight.mcap")
        shutil.copy((ROOT / FLIGHT).with_suffix(".expected"), system / "tmp/flight.expected")
        with_float_networks(ROOT / FLIGHT, system / "tmp/drone.yaml")
        for command, shows in STEPS:
            run(_within(system, command), Path(name), shows)
    print(f"{args.system} on {args.arch}: flockd is installed, sees its golden inputs, flies ten steps, and goes again")
    return deb.DONE


def _missing(arch: str, suite: Suite) -> str | None:
    """What this computer lacks, and the remedy; None: nothing."""
    machine = deb.MACHINES[arch]
    if os.geteuid() != 0:
        return "root is needed to make another system; run it with sudo"
    if shutil.which("debootstrap") is None:
        return "debootstrap is not installed; `apt install debootstrap`"
    if not Path(suite.keyring).is_file():
        return f"{suite.keyring} is missing, by which {suite.name} is known to be whole; install the keyring's package"
    if machine != platform.machine() and not (BINFMT / f"qemu-{machine}").is_file():
        return f"this kernel does not start programs of {machine}; `apt install qemu-user-static binfmt-support`"
    return None


def _within(system: Path, command: str) -> list[str]:
    """A shell's command in the system, with processes and a /proc of its own that end with it. Not with /sys: libraries
    look at this computer's processors there, and crash."""
    variables = ("PATH=/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL=C.UTF-8", "DEBIAN_FRONTEND=noninteractive")
    alone = ("unshare", "--mount", "--pid", "--fork", f"--root={system}", "--mount-proc")
    return [*alone, "env", "-i", *variables, "sh", "-c", command]


if __name__ == "__main__":
    sys.exit(main())
