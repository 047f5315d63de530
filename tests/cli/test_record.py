"""`flockd record`: what a person sees of a recording."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.conftest import Told
from tests.onboard.recording.made_up import MODELS, record


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "drone1.mcap"
    record(path)
    return path


@pytest.fixture
def cut_off(path: Path) -> Path:
    target = path.with_name("killed.mcap")
    target.write_bytes(path.read_bytes()[:-200_000])
    return target


def test_info_tells_what_is_in_it(path: Path, told: Told) -> None:
    facts = json.loads(told(0, "record", "info", "--json", path))
    assert (facts["drone"], facts["steps"], facts["finished"], facts["lost"]) == ("drone1", 10, True, 0)
    assert facts["duration_s"] == pytest.approx(0.9)
    assert (facts["gaps"], facts["damages"], facts["models"]) == ([], [], MODELS)
    assert facts["messages"]["/camera/front/image"] == 10
    assert "/camera/front/image: 10" in told(0, "record", "info", path)


def test_info_tells_of_a_recording_that_was_cut_off(cut_off: Path, told: Told) -> None:
    facts = json.loads(told(0, "record", "info", "--json", cut_off))
    assert not facts["finished"]
    assert facts["damages"][0]["reason"].startswith("it stops")
    assert "damage" in told(0, "record", "info", cut_off)


@pytest.mark.parametrize("command", [["record", "info"], ["replay"]], ids=" ".join)
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"not a recording", "is not a recording (it does not begin as MCAP files do); name another file"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is not a recording (but a pointer of Git LFS); fetch"),
        (b"#ROSBAG V2.0\n", "is not a recording (but a bag of ROS 1); make one of ROS 2 of it with `rosbags-convert`"),
        (b"\x89MCAP0\r\n", "nothing in it can be read"),
        (7000, "is cut off before the configuration|holds no step"),
    ],
)
def test_what_cannot_be_read_is_one_sentence_and_leaves_nothing(
    command: list[str], content: bytes | int, reason: str, path: Path, tmp_path: Path, told: Told
) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(content if isinstance(content, bytes) else path.read_bytes()[:content])
    before = set(tmp_path.iterdir())
    sentence = told(1, *command, bad)
    assert sentence.startswith(f"{bad}: ")
    assert any(one in sentence for one in reason.split("|"))
    assert set(tmp_path.iterdir()) == before
