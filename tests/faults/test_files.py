"""Files that a person is given: hostile recordings and images, read by the command as a process with little memory."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ground.datasets.test_image_headers import _claiming, told_of_huge
from tests.onboard.recording.made_up import record

pytestmark = pytest.mark.slow
RUN = "from flockd.cli import program; program()"
ROOT = Path(__file__).parents[2]
MEMORY_BYTES = 3 << 30
"""Address space; libraries take most of it."""


def _flockd(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", RUN, *arguments], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60.0,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES)),
    )  # fmt: skip


@pytest.mark.fault("hostile-recording")
@pytest.mark.parametrize("damage", ["middle", "sizes", "end", "header"])
def test_a_recording_is_hostile(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "drone1.mcap"
    record(path, steps=6)
    data = bytearray(path.read_bytes())
    match damage:
        case "middle":
            data[len(data) // 2 : len(data) // 2 + 400] = b"\xff" * 400
        case "sizes":
            data[9:17] = (2**63 + 5).to_bytes(8, "little")
        case "end":
            del data[len(data) // 3 :]
        case _:
            data[:8] = b"\x89PNG\r\n\x1a\n"
    path.write_bytes(data)
    for command in (["record", "info"], ["record", "recover", "--out", str(tmp_path / f"{damage}.mcap")], ["replay"]):
        ended = _flockd(*command[:2], str(path), *command[2:])
        assert ended.returncode in {0, 1}, ended.stderr
        assert "Traceback" not in ended.stderr
        if ended.returncode:
            assert f"{path}" in ended.stderr


@pytest.mark.fault("huge-image")
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_an_image_claims_to_be_huge(suffix: str, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    (images / f"one{suffix}").write_bytes(_claiming(suffix))
    ended = _flockd("calibrate", "camera", str(images), "--out", str(tmp_path / "lens.yaml"))
    assert ended.returncode == 1
    image = images / f"one{suffix}"
    assert ended.stderr.strip() == f"{image}: {told_of_huge(suffix)}; restore it, or leave its frame out"
