"""`flockd record`: what a person sees of a recording, and that nothing is left half-written."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.cli.conftest import Told
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
    images = next(stream for stream in facts["streams"] if stream["topic"] == "/camera/front/image")
    assert images["messages"] == 10
    assert images["rate_hz"] == pytest.approx(10.0)
    text = told(0, "record", "info", path)
    assert "foxglove.CompressedImage" in text
    assert "rate_hz: 10.0" in text


def test_info_tells_of_a_recording_that_was_cut_off(cut_off: Path, told: Told) -> None:
    facts = json.loads(told(0, "record", "info", "--json", cut_off))
    assert not facts["finished"]
    assert facts["damages"][0]["reason"].startswith("it stops")
    assert "damage" in told(0, "record", "info", cut_off)


def test_recover_makes_it_whole(cut_off: Path, told: Told) -> None:
    out = cut_off.with_name("killed.recovered.mcap")
    line = told(0, "record", "recover", cut_off)
    steps = json.loads(told(0, "record", "info", "--json", out))["steps"]
    assert line == f"{out}: {steps} of {steps} steps\n"
    assert 6 <= steps <= 9
    assert told(2, "record", "recover", cut_off).startswith(f"{out}: exists; ")


def test_cut_takes_a_stretch(path: Path, told: Told) -> None:
    out = path.with_name("cut.mcap")
    stretch = ("--start", "0.2", "--end", "0.5", "--out", out)
    assert json.loads(told(0, "record", "cut", path, *stretch, "--json"))["steps"] == 4
    late = told(2, "record", "cut", path, "--start", "5", "--out", path.with_name("late.mcap"))
    assert late.startswith(f"{path}: has no step from 5 s to 0.9 s, as it is 0.9 s long; ")
    between = told(2, "record", "cut", path, "--start", "0.32", "--end", "0.38", "--out", "x.mcap")
    assert "has no step from 0.32 s to 0.38 s" in between
    missing = told(2, "record", "cut", path, "--out", path.parent / "nowhere" / "cut.mcap")
    assert missing.startswith(f"{path.parent / 'nowhere'}: is no folder; ")
    assert {file.name for file in path.parent.iterdir()} == {"drone1.mcap", "cut.mcap"}


def test_export_writes_tables_and_images(path: Path, tmp_path: Path, told: Told) -> None:
    folder = tmp_path / "tables"
    result = json.loads(told(0, "record", "export", path, "--out", folder, "--images", "--json"))
    assert result["images"] == 20
    assert {"vehicle.csv", "output.csv", "output.neighbours.csv"} <= set(result["tables"])
    with (folder / "vehicle.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 10
    again = told(2, "record", "export", path, "--out", folder)
    assert again.startswith(f"{folder}: is not an empty folder; ")


@pytest.mark.parametrize("command", [["info"], ["recover"], ["cut", "--out"], ["export", "--out"], ["replay"]])
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "does not exist"),
        (b"not a recording", "is not a recording"),
        (b"\x89MCAP0\r\n", "nothing in it can be read"),
        (7000, "is cut off before the configuration|holds no step"),
    ],
)
def test_what_cannot_be_read_is_one_sentence_and_leaves_nothing(
    command: list[str], content: bytes | int | None, reason: str, path: Path, tmp_path: Path, told: Told
) -> None:
    bad = tmp_path / "bad.mcap"
    if content is not None:
        bad.write_bytes(content if isinstance(content, bytes) else path.read_bytes()[:content])
    before = set(tmp_path.iterdir())
    name, *option = command
    targets = [*option, *([str(tmp_path / "target")] if option else [])]
    sentence = told(1, *(["replay"] if name == "replay" else ["record", name]), bad, *targets)
    assert sentence.startswith(f"{bad}: ")
    assert any(one in sentence for one in reason.split("|"))
    assert set(tmp_path.iterdir()) == before
