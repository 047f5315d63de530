"""What the check in an emulated system says where it cannot run; by hand: `make install-emulated`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.review.replay import test_regression as regression
from tools.release import check_emulated


@pytest.mark.parametrize(
    ("lacks", "told"),
    [
        ("root", "root is needed to make another system; run it with sudo"),
        ("debootstrap", "debootstrap is not installed; `apt install debootstrap`"),
        ("keyring", "/nowhere.gpg is missing, by which bookworm is known to be whole; install the keyring's package"),
        ("qemu", "this kernel does not start programs of aarch64; `apt install qemu-user-static binfmt-support`"),
    ],
)
def test_what_this_computer_lacks_is_said_with_what_to_do(
    lacks: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "key.gpg").touch()
    keyring = "/nowhere.gpg" if lacks == "keyring" else str(tmp_path / "key.gpg")
    suite = check_emulated.SUITES["debian12"]._replace(keyring=keyring)
    monkeypatch.setitem(check_emulated.SUITES, "debian12", suite)
    monkeypatch.setattr("os.geteuid", lambda: 1000 if lacks == "root" else 0)
    monkeypatch.setattr("shutil.which", lambda _: None if lacks == "debootstrap" else "/usr/sbin/debootstrap")
    monkeypatch.setattr("platform.machine", lambda: "a computer's without emulation")
    monkeypatch.setattr(check_emulated, "BINFMT", tmp_path)
    monkeypatch.setattr("sys.argv", ["check_emulated", "--system", "debian12"])
    assert check_emulated.main() == 69
    assert capsys.readouterr().err == f"check_emulated: {told}\n"


def test_the_flight_has_to_come_out_as_in_the_tests() -> None:
    same = {*regression.TOLERANCES, *regression.OF_EGO_MOTION, *regression.OF_MOTIONS}
    assert {*check_emulated.TOLERANCES} == {*same, regression.OF_SIZES, regression.OF_MISSION}
