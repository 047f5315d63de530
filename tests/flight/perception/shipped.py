"""The interface of the shipped second stage, for fakes that stand in its place."""

from __future__ import annotations

from flockd.core.data import data_path
from flockd.flight.inference import load_manifest
from flockd.flight.perception.detection.second_stage import SecondStage

SECOND_STAGE = SecondStage.of(load_manifest(data_path("models") / "distance_int8.yaml")[0])
