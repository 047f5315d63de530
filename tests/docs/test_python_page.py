"""The programs of "Use it from Python" and of the README run as they stand, in a folder with the files they name."""

from __future__ import annotations

import json
import math
import re
import runpy
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flockd.cli import main
from tests.ground.pictures.photographs import DRONE_SIZE_M, RENDERED, truth

Printed = Callable[[str], list[str]]
ROOT = Path(__file__).parents[2]
REPLAY = ROOT / "tests" / "review" / "replay"
DETECT, TRACK, LAW, PILOT, SEE, FIGURES = (
    "Detect drones in a photograph",
    "Track your own detections",
    "Fly your own states by the flocking law",
    "Run the pilot over a recording",
    "See what the networks see",
    "Read a flight's figures into pandas",
)


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def sections() -> dict[str, str]:
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    return {heading: text for heading, _, text in (part.partition("\n") for part in page.split("\n## "))}


def program(heading: str) -> str:
    (text,) = blocks(sections()[heading], "python")
    return text


@pytest.fixture
def printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Printed:
    """The lines that a section's program prints, run as a file in the test's folder."""

    def run(heading: str) -> list[str]:
        (tmp_path / "program.py").write_text(program(heading), encoding="utf-8")
        monkeypatch.chdir(tmp_path)
        capfd.readouterr()
        runpy.run_path("program.py", run_name="__main__")
        out, err = capfd.readouterr()
        assert err == ""
        return out.splitlines()

    return run


def numbers(line: str) -> list[float]:
    return [float(number) for number in re.findall(r"[+-]?\d+(?:\.\d*)?", line)]


def recorded(folder: Path) -> None:
    """A recording where `flockd sim --record` of the page would have put one."""
    recordings = folder / "out" / "first" / "recordings"
    recordings.mkdir(parents=True)
    shutil.copy(REPLAY / "normal.mcap", recordings / "drone1.mcap")


def expected_steps() -> list[dict[str, Any]]:
    """What the recorded flight gives with the networks in 32-bit floats."""
    _, *lines = (REPLAY / "normal.expected").read_text(encoding="utf-8").splitlines()
    return [json.loads(line)["output"] for line in lines]


def test_every_program_is_tested_here() -> None:
    with_program = [heading for heading, text in sections().items() if blocks(text, "python")]
    assert with_program == [DETECT, TRACK, LAW, PILOT, SEE, FIGURES]


def test_the_readmes_program_is_one_of_the_pages() -> None:
    (text,) = blocks((ROOT / "README.md").read_text(encoding="utf-8"), "python")
    assert text == program(PILOT)


def test_detect_drones_in_a_photograph(tmp_path: Path, printed: Printed) -> None:
    name = "4_m_3.jpg"
    distances, boxes = truth()
    shutil.copy(RENDERED / name, tmp_path / "photograph.jpg")
    where, how_far, count = printed(DETECT)
    left, right, top, bottom, probability = numbers(where)
    assert (left, top, right - left, bottom - top) == pytest.approx(boxes[name], abs=8)
    assert probability > 0.9
    range_m, _, size_m = numbers(how_far)
    assert (range_m, size_m) == pytest.approx((distances[name], DRONE_SIZE_M), rel=0.06)
    assert numbers(count) == [1]


def test_track_your_own_detections(printed: Printed) -> None:
    """The neighbour starts 6 m to the north and flies to the east at 0.8 m/s; the false detection is at 2 s."""
    *steps, end = printed(TRACK)
    confirmed = [numbers(line) for line in steps if line.endswith(", confirmed")]
    assert {track for _, track, *_ in confirmed} == {1}
    assert [time_s for time_s, *_ in confirmed] == [0.5 + 0.5 * step for step in range(9)]
    for time_s, _, north, east in confirmed:
        assert (north, east) == pytest.approx((6.0, 0.8 * time_s), abs=0.1)
    assert next(numbers(line)[0] for line in steps if "track 2" in line) == 2.0
    assert numbers(end) == pytest.approx([0.0, 0.8, 0.0], abs=0.1)


def test_fly_your_own_states_by_the_flocking_law(printed: Printed) -> None:
    """Three drones are at rest in Eq. 38 where they are the desired distance apart and fly the desired velocity."""
    *_, last = printed(LAW)
    assert numbers(last) == pytest.approx([30, 3.0, 3.0, 3.0, 1.0, 0.0], abs=0.05)


def test_run_the_pilot_over_a_recording(tmp_path: Path, printed: Printed) -> None:
    recorded(tmp_path)
    lines = printed(PILOT)
    for line, expected in zip(lines, expected_steps(), strict=True):
        time_s, tracked, north, east = numbers(line)
        assert time_s == expected["time_s"]
        assert tracked == sum(neighbour["confirmed"] for neighbour in expected["neighbours"])
        assert (north, east) == pytest.approx(expected["command"]["velocity"], abs=0.1)


def test_see_what_the_networks_see(tmp_path: Path, printed: Printed) -> None:
    """The one neighbour flies ahead; a range's standard deviation is 5 cm. As the page says, one image may miss it."""
    recorded(tmp_path)
    steps = list(zip(printed(SEE), expected_steps(), strict=True))
    seen = [(line, expected) for line, expected in steps if not line.endswith("[]")]
    assert len(seen) >= 0.7 * len(steps)
    for line, expected in seen:
        time_s, depth_m, range_m = numbers(line)
        (detection,) = expected["detections"]
        assert time_s == expected["time_s"]
        assert 1.0 < depth_m < 100.0
        assert range_m == pytest.approx(math.exp(detection["log_range"]), abs=0.15)
        assert line.endswith("m by front']")


def test_read_a_flights_figures_into_pandas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    recorded(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flockd.review.report.flight_folder.write_report", lambda folder, *_: folder)
    (commands,) = blocks(sections()[FIGURES], "sh")
    for command in commands.splitlines():
        assert main(shlex.split(command)[1:]) == 0
    lines = printed(FIGURES)
    flights = {words[0]: words[1:] for words in map(str.split, lines)}
    for name, drones in (("three", 3), ("six", 6)):
        summary = json.loads((tmp_path / "out" / name / "summary.json").read_text(encoding="utf-8"))
        flock = summary["flock"]
        assert numbers(flights[name][0]) == [drones]
        assert [float(one) for one in flights[name][1:]] == pytest.approx(
            [flock["min_distance_m"], flock["order_tail"]], abs=1e-5
        )
    count, nearest_m, _, farthest_m = (float(one) for one in flights["1"])
    assert count == 10
    assert 2.5 < nearest_m < farthest_m < 4.0
