"""Ranges and sizes that know what they do not know: of airframes that the networks learnt, and of others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.flight.inference import OnnxModel
from flockd.flight.perception import load_networks
from flockd.flight.perception.interface import Crops, RangeEstimates
from flockd.flight.perception.onnx import OnnxNetworks
from flockd.ground.datasets.image_files import read_image
from flockd.ground.pictures.single_frame import KNOWN_LOG_SIZE_SIGMA, UNKNOWN_LOG_SIZE_SIGMA, PictureDetector
from tests.ground.pictures.photographs import FOV_DEG, RENDERED, truth
from tools.measure.evaluate_crops import held_out
from tools.training import worlds
from tools.training.render_drone_crops import CropJob, _render_world


class Doubtful:
    """The shipped networks, but for what they say of their own doubt about a size."""

    def __init__(self, networks: OnnxNetworks, log_size_sigma: float) -> None:
        self._networks, self._sigma = networks, log_size_sigma

    def __getattr__(self, name: str) -> object:
        return getattr(self._networks, name)

    def ranges(self, crops: Crops) -> RangeEstimates:
        return self._networks.ranges(crops)._replace(log_size_sigma=np.full(len(crops), self._sigma))


@pytest.mark.parametrize(("doubt", "said_m", "known"), [(0.02, None, True), (0.2, None, False), (0.2, 0.35, True)])
def test_a_size_that_the_network_doubts_may_be_any_unless_it_is_said(
    doubt: float, said_m: float | None, known: bool
) -> None:
    config = PerceptionConfig(drone_size_m=said_m, drone_size_sigma_m=0.01)
    detector = PictureDetector(config, Doubtful(load_networks(config), doubt))  # type: ignore[arg-type]
    (found,) = detector.detect(read_image(RENDERED / "2.5_m_0.jpg"), fov_deg=FOV_DEG).detections
    assert found.kind_known is known
    if known:
        assert found.range_sigma_m / found.range_m == pytest.approx(
            doubt if said_m is None else 0.01 / said_m, abs=0.015
        )
    else:
        assert 0.85 < found.range_sigma_m / found.range_m < 0.88, (
            "a factor of 2.3 either way, and the error of the apparent size"
        )
        assert 0.85 < found.size_sigma_m / found.size_m < 0.88


def test_the_table_says_where_the_kind_is_unknown_and_its_interval_holds_the_truth(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The drone of 4_m_4 is seen before a house: the network takes it for one of 0.41 m, and doubts it."""
    main(["detect", str(RENDERED / "4_m_4.jpg"), str(RENDERED / "4_m_3.jpg"), "--fov", f"{FOV_DEG:g}"])
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    words = rows["4_m_4.jpg"].split()
    assert words[-2:] == ["kind", "unknown"]
    low, high = float(words[-5]), float(words[-3])
    assert low < truth()[0]["4_m_4.jpg"] < high
    assert high / low == pytest.approx(np.exp(2 * 0.85), rel=0.2)
    assert rows["4_m_3.jpg"].split()[-3:-1] == ["0.69", "+-"]


def test_sigma_covers_the_errors_of_airframes_that_no_network_learnt(tmp_path: Path) -> None:
    """Of the two that the renderer holds out: 68 % within one standard deviation, and 95 % within two."""
    _render_world(CropJob(tmp_path / "crops.npz", worlds.TEST[-3], 150, [], measures=True))
    crops, _ = held_out(tmp_path)
    model = OnnxModel(data_path("models") / "distance_int8.yaml", threads=1)
    out = model.manifest.results["range"].by_column(model.run({"picture": crops["picture"]})["range"])
    off = np.abs(out["log_range_per_focal"] - crops["target"][:, 0])
    doubt = np.exp(out["log_size_sigma"])
    sigma = np.where(doubt < KNOWN_LOG_SIZE_SIGMA, doubt, UNKNOWN_LOG_SIZE_SIGMA)
    assert len(off) > 80
    assert np.mean(off < sigma) > 0.68
    assert np.mean(off < 2 * sigma) > 0.95
    assert np.mean(off < 2 * np.minimum(doubt, 0.5)) < 0.92, "the network's own would not"
