"""Replays a dataset: the pilot's ego-motion from pairs of frames, measured against the poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.geometry import GeometryParameters
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.rig import RigConfig
from flockd.flight.perception import load_networks
from flockd.ground.datasets import Dataset
from flockd.onboard.recording.editing import written_whole
from flockd.review.replay.dataset_pairs import Pair, fly_pairs, size_of
from flockd.review.replay.trajectory import integrate, tum_text

Depth = Literal["recorded", "network"]

_ANY_ACCELERATION_M_S2 = 1e9
"""A hand-held camera does not keep to a drone's limits."""
_STRIDE_PX = 6
"""One camera has to give as many points as the four of a drone."""


def dataset_config(dataset: Dataset, config: DroneConfig | None, depth: Depth, flow: str | None) -> DroneConfig:
    """The settings to replay with, for the dataset's camera: scale by the network, and the flow model that is named.

    ``config``: a drone's; None: settings for a hand-held camera.
    """
    rig = RigConfig(cameras=(dataset.camera,))
    if config is None:
        geometry = GeometryParameters(
            max_acceleration_m_s2=_ANY_ACCELERATION_M_S2,
            background_stride_px=_STRIDE_PX,
            # The refinement's weights are for a network's depth; a sensor's is better than that.
            refine=depth != "recorded",
        )
        perception = PerceptionConfig(scale="network", flow_refinement="dis")
        config = DroneConfig(rig=rig, geometry=geometry, perception=perception)
    changes = {"scale": "network", "flow": flow or config.perception.flow}
    update = {"rig": rig, "source": None, "perception": config.perception.model_copy(update=changes)}
    return config.model_copy(update=update)


def replay_dataset(
    dataset: Dataset, config: DroneConfig, stride: int, depth: Depth, progress: Callable[[int, int], None]
) -> list[Pair]:
    """The motion from each frame ``i`` to frame ``i + stride``. Raises DatasetError, ModelError."""
    pairs: list[Pair] = []
    learned = load_networks(config.perception)
    for pair in fly_pairs(dataset, config, learned, stride=stride, recorded_depth=depth == "recorded"):
        pairs.append(pair)
        progress(len(pairs), len(dataset) - stride)
    return pairs


def dataset_result(pairs: Sequence[Pair]) -> dict[str, Any]:
    """The result of a replay as JSON, for `flockd replay --json`."""
    errors = [pair.error for pair in pairs if pair.error]
    return {
        "pairs": [_pair_result(pair) for pair in pairs],
        "rotation_error_deg": _spread([rotation for rotation, _ in errors]),
        "translation_error_m": _spread([translation for _, translation in errors]),
        "estimated_ratio": sum(pair.found is not None for pair in pairs) / len(pairs),
    }


def write_trajectory(path: Path, pairs: Sequence[Pair], stride: int) -> Pair | None:
    """Writes the integrated path in TUM format; returns the pair that it ends before, None for a whole path."""
    track, broken = integrate(pairs, stride)
    with written_whole(path) as draft:
        draft.write_text(tum_text(track), encoding="utf-8")
    return broken


def _pair_result(pair: Pair) -> dict[str, Any]:
    true_rotation, true_translation = size_of(pair.true) if pair.true else (None, None)
    rotation_error, translation_error = pair.error or (None, None)
    return {
        "from": pair.before.index,
        "to": pair.after.index,
        "true_rotation_deg": true_rotation,
        "true_translation_m": true_translation,
        "rotation_error_deg": rotation_error,
        "translation_error_m": translation_error,
        "inlier_ratio": pair.inlier_ratio,
        "estimated": pair.found is not None,
        "reason": pair.reason,
    }


def _spread(samples: Sequence[float]) -> dict[str, float | None]:
    """None without samples."""
    if not samples:
        return {"median": None, "p95": None, "max": None}
    median, p95, largest = np.percentile(samples, (50, 95, 100))
    return {"median": float(median), "p95": float(p95), "max": float(largest)}
