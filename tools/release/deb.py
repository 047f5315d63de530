"""Build a Debian package of flockd with everything that it needs to fly.

python -m tools.release.deb --arch arm64                          # dist/flockd_..._arm64.deb, for Debian 12
python -m tools.release.deb --arch amd64 --system ubuntu24.04 --out packages

Needs no root, no compiler and no computer of that architecture: pip, `dpkg-deb`, and a package index for the wheels
that requirements/service.txt names, each checked against its hash. The package is a virtual environment in
/usr/lib/flockd that uses the distribution's Python, so each distribution needs its own. Nothing of it runs while it is
installed but the scripts of packaging/deb. The same commit gives the same bytes: times are those of the commit, or
SOURCE_DATE_EPOCH.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flockd import __version__
from tools.release import wheels
from tools.release.wheels import ROOT

PACKAGING = ROOT / "packaging" / "deb"
SCRIPTS = ("preinst", "postinst", "prerm", "postrm")
HOME = "usr/lib/flockd"
"""The virtual environment."""
UNIT_FOLDER = "usr/lib/systemd/system"
HAND_MADE, PACKAGED = "/opt/flockd/bin/flockd", "/usr/bin/flockd"
"""The command that the units of systemd/ start, and the package's."""
COMMAND = f"""\
#!/{HOME}/bin/python
from flockd.cli import program

program()
"""
DONE, UNAVAILABLE = 0, 69


@dataclass(frozen=True)
class System:
    """A distribution that a package can be for."""

    title: str
    release: str
    """`ID` and `VERSION_ID` of its /etc/os-release."""
    python: str


SYSTEMS = {
    "debian12": System("Debian 12", "debian 12", "3.11"),
    "debian13": System("Debian 13", "debian 13", "3.13"),
    "ubuntu24.04": System("Ubuntu 24.04", "ubuntu 24.04", "3.12"),
}
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""Debian's names of the architectures, and the kernel's."""


class UnavailableError(Exception):
    """Something needed is not there; the text says what."""


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", required=True, choices=tuple(MACHINES))
    parser.add_argument("--system", default="debian12", choices=tuple(SYSTEMS), help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("dist"), metavar="FOLDER", help="default: %(default)s")
    parser.add_argument("--version", default=__version__, help="default: that of flockd/__init__.py, %(default)s")
    arguments = parser.parse_args()
    try:
        file = build(arguments.out, arguments.arch, arguments.system, arguments.version)
    except UnavailableError as error:
        print(f"deb: {error}", file=sys.stderr)
        return UNAVAILABLE
    except subprocess.CalledProcessError as error:
        print(f"deb: {' '.join(map(str, error.cmd[:4]))} failed; what it printed stands above", file=sys.stderr)
        return UNAVAILABLE
    print(f"{file}: {file.stat().st_size / 1e6:.0f} MB, sha256 {hashlib.sha256(file.read_bytes()).hexdigest()}")
    return DONE


def build(out: Path, arch: str, system: str, version: str, *, level: int = 9) -> Path:
    """Writes the package into ``out`` and gives its path.

    ``level``: of compression, 1 to 19.
    Raises UnavailableError where dpkg or a time is missing, CalledProcessError where pip or dpkg fails.
    """
    if shutil.which("dpkg-deb") is None:
        raise UnavailableError("dpkg-deb is not installed; `sudo apt install dpkg`")
    epoch_s = _source_date()
    full_version = f"{version}+{system}"
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"flockd_{full_version}_{arch}.deb"
    with tempfile.TemporaryDirectory() as scratch:
        tree, own, shelf = (Path(scratch) / name for name in ("tree", "own", "wheels"))
        python = SYSTEMS[system].python
        wheels.download_locked(shelf, machine=MACHINES[arch], python=python)
        _environment(tree, [*wheels.locked(shelf), wheels.build_own(own, shelf)], python)
        _system_files(tree)
        _documents(tree, full_version, epoch_s)
        values = {
            "VERSION": full_version,
            "ARCH": arch,
            "SYSTEM": SYSTEMS[system].title,
            "RELEASE": SYSTEMS[system].release,
            "PYTHON": python,
            "SIZE_KB": str(sum(path.stat().st_size for path in tree.rglob("*") if path.is_file()) // 1024),
        }
        _control(tree, values)
        _set_modes(tree)
        command = ["dpkg-deb", "--root-owner-group", "-Zzstd", f"-z{level}", "--build", str(tree), str(file)]
        environment = {**os.environ, "SOURCE_DATE_EPOCH": str(epoch_s)}
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
    return file


def _environment(tree: Path, contents: Sequence[Path], python: str) -> None:
    """The virtual environment: what `python -m venv` and pip make of the wheels, made without running them."""
    home = tree / HOME
    (home / "bin").mkdir(parents=True)
    for wheel in contents:
        wheels.unpack(wheel, home / "lib" / f"python{python}" / "site-packages")
    (home / "pyvenv.cfg").write_text("home = /usr/bin\ninclude-system-site-packages = false\n", encoding="utf-8")
    (home / "bin/python").symlink_to(f"../../../bin/python{python}")
    _write(home / "bin/flockd", COMMAND)
    command = tree / PACKAGED.lstrip("/")
    command.parent.mkdir()
    command.symlink_to("../lib/flockd/bin/flockd")


def _system_files(tree: Path) -> None:
    """Units, user and configuration."""
    for unit in (ROOT / "systemd").glob("*.service"):
        text = unit.read_text(encoding="utf-8")
        _write(tree / UNIT_FOLDER / unit.name, text.replace(HAND_MADE, PACKAGED))
    _write(tree / "usr/lib/sysusers.d/flockd.conf", (ROOT / "systemd/flockd.sysusers.conf").read_text(encoding="utf-8"))
    _write(tree / "etc/flockd/drone.yaml", (ROOT / "config/quadrotor.yaml").read_text(encoding="utf-8"))


def _documents(tree: Path, version: str, epoch_s: int) -> None:
    """Licence and changes, where Debian has them."""
    folder = tree / "usr/share/doc/flockd"
    _write(folder / "copyright", (PACKAGING / "copyright").read_text(encoding="utf-8"))
    _write(folder / "NOTICE", (ROOT / "NOTICE").read_text(encoding="utf-8"))
    date = time.strftime("%a, %d %b %Y %H:%M:%S +0000", time.gmtime(epoch_s))
    entry = f"flockd ({version}) stable; urgency=medium\n\n  * See NEWS.md.gz.\n\n -- {_maintainer()}  {date}\n"
    news = (ROOT / "CHANGELOG.md").read_bytes()
    for name, content in (("changelog.gz", entry.encode()), ("NEWS.md.gz", news)):
        (folder / name).write_bytes(gzip.compress(content, mtime=0))
    _write(tree / "usr/share/lintian/overrides/flockd", (PACKAGING / "lintian-overrides").read_text(encoding="utf-8"))


def _control(tree: Path, values: Mapping[str, str]) -> None:
    """What dpkg reads: description, scripts, and the names and hashes of files."""
    folder = tree / "DEBIAN"
    folder.mkdir()
    for name in ("control", *SCRIPTS):
        text = (PACKAGING / name).read_text(encoding="utf-8")
        for key, value in values.items():
            text = text.replace(f"@{key}@", value)
        _write(folder / name, text)
    files = sorted(path for path in tree.rglob("*") if path.is_file() and not path.is_symlink())
    listed = [path.relative_to(tree) for path in files if folder not in path.parents]
    settings = [path for path in listed if path.parts[0] == "etc"]
    _write(folder / "conffiles", "".join(f"/{path}\n" for path in settings))
    sums = (
        f"{hashlib.md5((tree / path).read_bytes()).hexdigest()}  {path}\n" for path in listed if path not in settings
    )
    _write(folder / "md5sums", "".join(sums))


def _set_modes(tree: Path) -> None:
    """Set the modes of all files, independent of the umask and of the wheels."""
    programs = {tree / HOME / "bin/flockd", *(tree / "DEBIAN" / name for name in SCRIPTS)}
    for path in [tree, *tree.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or path in programs else 0o644)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _maintainer() -> str:
    control = (PACKAGING / "control").read_text(encoding="utf-8")
    return next(line for line in control.splitlines() if line.startswith("Maintainer: ")).partition(": ")[2]


def _source_date() -> int:
    """Seconds since 1970: SOURCE_DATE_EPOCH, or the time of the last commit. Raises UnavailableError."""
    given = os.environ.get("SOURCE_DATE_EPOCH")
    if given is None:
        command = ["git", "-C", str(ROOT), "log", "-1", "--format=%ct"]
        result = subprocess.run(command, capture_output=True, text=True, check=False) if shutil.which("git") else None
        given = result.stdout.strip() if result is not None and result.returncode == 0 else ""
    if not given.isdecimal():
        raise UnavailableError("no commit tells the package's date; set SOURCE_DATE_EPOCH to seconds since 1970")
    return int(given)


if __name__ == "__main__":
    sys.exit(main())
