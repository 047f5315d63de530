"""The Debian package: what lies where in it, and what its scripts do and leave alone. No package index is asked."""

from __future__ import annotations

import gzip
import hashlib
import os
import re
import subprocess
import zipfile
from pathlib import Path

import pytest

from tools.release import deb, wheels
from tools.release.wheels import names_of_lock

VALUES = {"VERSION": "1+debian12", "ARCH": "arm64", "SYSTEM": "Debian 12", "RELEASE": "debian 12", "PYTHON": "3.11"}
ABSOLUTE = re.compile(r"(?<![\w/.-])/(?=(?:usr/lib|usr/bin|etc|run|var)/)")
RECORDED = """\
#!/bin/sh
echo "$(basename "$0") $*" >> "$CALLS"
case "$*" in *list-units*) printf "%s" "$RUNNING" ;; esac
"""


def a_wheel(folder: Path, name: str) -> Path:
    path = folder / f"{name}-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}/__init__.py", f"# {name}\n")
        archive.writestr(f"{name}-1.0.dist-info/METADATA", f"Name: {name}\n")
    return path


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A package as it is before dpkg-deb packs it, of two small wheels, made by somebody who shares nothing."""
    root, before = tmp_path / "tree", os.umask(0o077)
    contents = [a_wheel(tmp_path, "flockd"), a_wheel(tmp_path, "numpy")]
    deb._environment(root, contents, VALUES["PYTHON"])
    deb._system_files(root)
    deb._documents(root, VALUES["VERSION"], 1_700_000_000)
    deb._control(root, {**VALUES, "SIZE_KB": "1"})
    deb._set_modes(root)
    os.umask(before)
    return root


def test_the_unit_starts_what_the_package_brings(tree: Path) -> None:
    """From ExecStart over the command's first line to the distribution's Python, every link of the chain is there."""
    for name in ("flockd.service", "flockd@.service"):
        unit = (tree / "usr/lib/systemd/system" / name).read_text(encoding="utf-8")
        assert re.findall(r"^ExecStart=(\S+) run --config /etc/flockd/", unit, re.MULTILINE) == ["/usr/bin/flockd"]
        assert "/opt" not in unit
    command = (tree / "usr/bin" / (tree / "usr/bin/flockd").readlink()).resolve()
    interpreter = command.read_text(encoding="utf-8").splitlines()[0].removeprefix("#!/")
    assert os.access(command, os.X_OK)
    target = (tree / interpreter).parent / (tree / interpreter).readlink()
    assert target.resolve().relative_to(tree.resolve()) == Path("usr/bin/python3.11")
    assert (tree / "usr/lib/flockd/pyvenv.cfg").is_file()
    assert (tree / "usr/lib/flockd/lib/python3.11/site-packages/numpy/__init__.py").is_file()


def test_what_dpkg_reads_is_whole(tree: Path) -> None:
    control = tree / "DEBIAN"
    assert (control / "conffiles").read_text(encoding="utf-8") == "/etc/flockd/drone.yaml\n"
    for line in (control / "md5sums").read_text(encoding="utf-8").splitlines():
        digest, _, name = line.partition("  ")
        assert hashlib.md5((tree / name).read_bytes()).hexdigest() == digest
    for name in ("control", *deb.SCRIPTS):
        assert re.findall(r"@[A-Z_]+@", (control / name).read_text(encoding="utf-8")) == [], name
    assert "Depends: python3.11, " in (control / "control").read_text(encoding="utf-8")
    changes = gzip.decompress((tree / "usr/share/doc/flockd/changelog.gz").read_bytes()).decode()
    assert changes.endswith("  Tue, 14 Nov 2023 22:13:20 +0000\n")


def test_modes_are_the_same_whatever_the_umask_was(tree: Path) -> None:
    for path in tree.rglob("*"):
        if not path.is_symlink():
            runs = path.is_dir() or (path.name in ("flockd", *deb.SCRIPTS) and path.parent.name in ("bin", "DEBIAN"))
            assert path.stat().st_mode & 0o7777 == (0o755 if runs else 0o644), path


def test_it_brings_the_lock_and_nothing_that_only_builds(tmp_path: Path) -> None:
    names = names_of_lock()
    for name in [*names, "pymavlink"]:
        (tmp_path / f"{name.replace('-', '_')}-1.0-py3-none-any.whl").touch()
    brought = {path.name.partition("-")[0].replace("_", "-") for path in wheels.locked(tmp_path)}
    assert brought == set(names) - {"setuptools"}


def test_a_wheel_with_files_elsewhere_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("odd-1.0.data/scripts/odd", "")
    with pytest.raises(ValueError, match=r"odd-1\.0\.data/scripts/odd outside site-packages"):
        wheels.unpack(path, tmp_path / "there")


class Computer:
    """Folders in the place of a computer's, and commands that only write down how they were called."""

    def __init__(self, folder: Path, scripts: Path) -> None:
        self.root, self._scripts, self._calls = folder / "root", scripts, folder / "calls"
        for name in ("run/systemd/system", "etc/systemd/system", "var/lib", "usr/bin", "usr/lib/flockd/bin"):
            (self.root / name).mkdir(parents=True)
        commands = folder / "commands"
        commands.mkdir()
        paths = [commands / name for name in ("systemctl", "systemd-sysusers", "userdel", "getent")]
        for path in [*paths, self.root / "usr/lib/flockd/bin/python"]:
            path.write_text(RECORDED, encoding="utf-8")
            path.chmod(0o755)
        self._environment = {"PATH": f"{commands}:/usr/bin:/bin", "CALLS": str(self._calls)}

    def runs(self, script: str, *arguments: str, running: str = "") -> subprocess.CompletedProcess[str]:
        text = ABSOLUTE.sub(f"{self.root}/", (self._scripts / script).read_text(encoding="utf-8"))
        environment = {**self._environment, "RUNNING": running}
        command = ["sh", "-c", text, script, *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    @property
    def calls(self) -> str:
        return self._calls.read_text(encoding="utf-8") if self._calls.exists() else ""


@pytest.fixture
def computer(tree: Path, tmp_path: Path) -> Computer:
    return Computer(tmp_path, tree / "DEBIAN")


def test_an_upgrade_leaves_what_flies_alone_and_says_so(computer: Computer) -> None:
    units = "flockd.service loaded active running x\nflockd@two.service loaded active running x\n"
    for script, arguments in (
        ("prerm", ["upgrade", "2"]),
        ("postrm", ["upgrade", "2"]),
        ("postinst", ["configure", "1"]),
    ):
        done = computer.runs(script, *arguments, running=units)
        assert done.returncode == 0, done.stderr
    assert "sudo systemctl restart flockd.service flockd@two.service\n" in done.stdout
    asked = [line.split()[1] for line in computer.calls.splitlines() if line.startswith("systemctl ")]
    assert asked == ["daemon-reload", "list-units"]


def test_a_first_installation_starts_nothing_and_says_what_is_next(computer: Computer) -> None:
    done = computer.runs("postinst", "configure", "")
    assert done.returncode == 0, done.stderr
    assert "fill in " in done.stdout
    assert "flockd config check" in done.stdout
    assert "systemctl enable --now flockd" in done.stdout
    assert re.findall(r"systemctl.*\b(?:start|enable)\b", computer.calls) == []
    assert "systemd-sysusers flockd.conf" in computer.calls
    assert "python -I -m compileall" in computer.calls


@pytest.mark.parametrize(
    ("system", "has_python", "refused"),
    [
        ("ID=debian\nVERSION_ID=12\nPRETTY_NAME='Debian 12'", False, False),
        ("ID=ubuntu\nVERSION_ID=22.04\nPRETTY_NAME='Ubuntu 22.04.5 LTS'", False, True),
        ("ID=ubuntu\nVERSION_ID=22.04\nPRETTY_NAME='Ubuntu 22.04.5 LTS'", True, False),
    ],
)
def test_a_computer_that_it_is_not_for_is_told(
    computer: Computer, system: str, has_python: bool, refused: bool
) -> None:
    (computer.root / "etc/os-release").write_text(system, encoding="utf-8")
    if has_python:
        (computer.root / "usr/bin/python3.11").touch()
        (computer.root / "usr/bin/python3.11").chmod(0o755)
    done = computer.runs("preinst", "install")
    assert done.returncode == refused
    assert ("is for Debian 12 and its Python 3.11, which Ubuntu 22.04.5 LTS does not have" in done.stderr) == refused


def test_removed_it_stops_and_leaves_no_compiled_file(computer: Computer) -> None:
    cache = computer.root / "usr/lib/flockd/lib/python3.11/site-packages/numpy/__pycache__"
    cache.mkdir(parents=True)
    (cache / "a.pyc").touch()
    done = computer.runs("prerm", "remove")
    assert done.returncode == 0, done.stderr
    assert "systemctl stop flockd.service flockd@*.service" in computer.calls
    assert not cache.exists()


def test_purged_it_keeps_recordings_and_their_owner_alone(computer: Computer) -> None:
    recording = computer.root / "var/lib/flockd/drone1.mcap"
    recording.parent.mkdir()
    recording.touch()
    kept = computer.runs("postrm", "purge")
    assert kept.returncode == 0, kept.stderr
    assert recording.exists()
    assert "recordings stay in" in kept.stdout
    assert "userdel" not in computer.calls
    recording.unlink()
    assert computer.runs("postrm", "purge").stdout == ""
    assert not recording.parent.exists()
    assert "userdel flockd" in computer.calls
