"""`flockd calibrate drone`: a size from pictures at known distances, or the reason why there is none."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from flockd.cli import main
from flockd.core.config.perception import PerceptionConfig
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.calibration.drone_size import DroneSize, Photograph, SizeCandidate, fit_size
from tests.ground.pictures.photographs import DRONE_SIZE_M, FOV_DEG, RENDERED, truth

Capture = pytest.CaptureFixture[str]
FOV = ("--fov", f"{FOV_DEG:g}")


def photograph(name: str, distance_m: float, *sizes_m: float, sigma: float = 0.03) -> Photograph:
    return Photograph(name, distance_m, tuple(SizeCandidate(size, sigma, 0.9) for size in sizes_m))


def shots(*sizes_m: float) -> list[Photograph]:
    return [photograph(f"{k}.jpg", 3.0 + k, size) for k, size in enumerate(sizes_m)]


def test_the_size_is_the_weighted_mean_of_the_logs() -> None:
    """At 2 m a tape's 2 cm are 1 %; with 3 % of the network and 4 % from view to view that is 5.1 % a picture."""
    pictures = [photograph(f"{k}.jpg", 2.0, size) for k, size in enumerate((0.5, 0.5, 0.55, 0.55))]
    size = fit_size(pictures)
    assert size.size_m == pytest.approx(math.sqrt(0.5 * 0.55))
    spread = math.log(1.1) / 2  # of every log around the mean: more than 5.1 % would explain is not there
    assert spread < 0.051
    assert size.sigma_m / size.size_m == pytest.approx(math.sqrt(0.03**2 + 0.04**2 + 0.01**2) / 2, rel=0.09)
    assert [one.residual(size.size_m) for one in size.pictures] == pytest.approx(
        [math.sqrt(1.1) - 1] * 2 + [1 / math.sqrt(1.1) - 1] * 2
    )


def test_pictures_that_differ_more_than_their_deviations_say_enlarge_the_results() -> None:
    """By the root of chi-square over the degrees of freedom."""
    rng = np.random.default_rng(0)
    logs = math.log(0.4) + rng.normal(0, 0.07, 12)
    size = fit_size([photograph(f"{k}.jpg", 2.0, math.exp(one), sigma=0.0) for k, one in enumerate(logs)])
    assert size.size_m == pytest.approx(math.exp(logs.mean()))
    assert size.sigma_m / size.size_m == pytest.approx(logs.std(ddof=1) / math.sqrt(12))


def test_one_picture_that_contradicts_the_others_is_dropped_by_name() -> None:
    size = fit_size(shots(0.35, 0.34, 0.36, 0.35, 0.60))
    assert size.size_m == pytest.approx(0.35, rel=0.02)
    assert [one.name for one in size.pictures if not one.used] == ["4.jpg"]


def test_of_several_detections_the_one_that_agrees_is_taken() -> None:
    """A tree may be taken for a drone in every picture; at each distance it would be of another size."""
    pictures = [
        photograph(f"{k}.jpg", 3.0 + k, *sizes)
        for k, sizes in enumerate([(0.9, 0.35), (0.36, 1.2), (0.35,), (1.6, 0.34), ()])
    ]
    size = fit_size(pictures)
    assert size.size_m == pytest.approx(0.35, rel=0.02)
    assert [one.size_m for one in size.pictures] == [0.35, 0.36, 0.35, 0.34]
    assert size.missed == ("4.jpg",)


@pytest.mark.parametrize(
    ("pictures", "sentence"),
    [
        (
            shots(0.35, 0.35, 0.6, 0.6, 0.35),
            "the pictures contradict each other: the drone's size is 0.35 m by 3 of them",
        ),
        (
            shots(0.35, 0.36, 0.35, 0.35, 0.6, 0.6, 0.6),
            "and 0.60 m by 4.jpg at 7 m, 0.60 m by 5.jpg at 8 m, 0.60 m by 6",
        ),
        (shots(0.35, 0.35, 0.6, 0.2), "0.60 m by 2.jpg at 5 m, 0.20 m by 3.jpg at 6 m; check the distances"),
        (shots(0.35, 0.35, 0.35), "the drone is detected in 3 pictures; take at least 4"),
        ([*shots(0.35), photograph("x.jpg", 3.0)], "detected in 1 pictures, and none is detected in 1 more; take at"),
        (shots(30.0, 30.0, 30.0, 30.0), "a size of 30.000 m is no drone's (0.05 to 5 m); check the distances, which"),
        (
            [photograph(f"{k}.jpg", 3.0, 0.4, sigma=0.5) for k in range(4)],
            "the size is 0.400 m +- 25 %, which is too uncertain to fly with; take more pictures",
        ),
    ],
)
def test_what_is_not_enough_is_refused(pictures: list[Photograph], sentence: str) -> None:
    with pytest.raises(CalibrationError) as raised:
        fit_size(pictures)
    assert sentence in str(raised.value)


def test_the_fragment_is_a_part_of_a_drones_file() -> None:
    size = DroneSize(0.35218, 0.00431, (), ())
    assert yaml.safe_load(size.fragment("3 m: 4")) == {
        "perception": {"drone_size_m": 0.3522, "drone_size_sigma_m": 0.0043}
    }


def by_distance() -> list[str]:
    """The rendered photographs as options."""
    options: list[str] = []
    distances = truth()[0]
    for distance_m in sorted(set(distances.values())):
        options += ["--distance", f"{distance_m:g}"]
        options += [str(RENDERED / name) for name, value in distances.items() if value == distance_m]
    return options


def test_rendered_photographs_give_the_drones_size(capsys: Capture, tmp_path: Path) -> None:
    out = tmp_path / "size.yaml"
    assert main(["calibrate", "drone", *by_distance(), *FOV, "--out", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["drone_size_m"] == pytest.approx(DRONE_SIZE_M, rel=0.06)
    assert 0 < result["drone_size_sigma_m"] < 0.05 * DRONE_SIZE_M
    assert abs(result["drone_size_m"] - DRONE_SIZE_M) < 3 * result["drone_size_sigma_m"]
    assert len(result["pictures"]) + len(result["missed"]) == 9
    perception = PerceptionConfig.model_validate(yaml.safe_load(out.read_text())["perception"])
    assert perception.drone_size_m == result["drone_size_m"]
    # Nothing that is there is lost by accident.
    assert main(["calibrate", "drone", *by_distance(), *FOV, "--out", str(out)]) == 2
    assert "exists; name another file, or overwrite it with --force" in capsys.readouterr().err


def test_wrong_distances_are_refused(capsys: Capture, tmp_path: Path) -> None:
    """Three of six pictures at 2.5 m are said to be of 5 m, as from a wrong note: twice the size."""
    for k in range(3):
        shutil.copy(RENDERED / f"2.5_m_{k}.jpg", tmp_path / f"again_{k}.jpg")
    given = ("--distance", "2.5", *sorted(map(str, RENDERED.glob("2.5_*"))), "--distance", "5", str(tmp_path))
    assert main(["calibrate", "drone", *given, *FOV, "--out", str(tmp_path / "size.yaml")]) == 1
    error = capsys.readouterr().err
    assert "the pictures contradict each other" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "size.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "name the pictures and their distances with --distance"),
        (("--distance", "3"), "--distance 3: names no picture"),
        (("--distance", "near", "a.jpg"), "'near' is not a positive number; write metres, then the pictures"),
        (("--distance", "300", "a.jpg"), "300 is more than 200 m"),
        (("--distance", "3", "nowhere.jpg", *FOV), "nowhere.jpg: does not exist"),
        (("--distance", "3", "a.jpg"), "the pictures' camera is not known"),
    ],
)
def test_wrong_options_are_usage_errors(
    capsys: Capture, tmp_path: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    assert main(["calibrate", "drone", *arguments, "--out", str(tmp_path / "size.yaml")]) == 2
    assert sentence in capsys.readouterr().err
