"""Interface of a network of the second stage: how its crops are cut, and how its outputs are judged."""

from __future__ import annotations

from dataclasses import dataclass

from flockd.core.errors import ModelError
from flockd.flight.inference import Manifest
from flockd.flight.inference.manifest import CropSpec


@dataclass(frozen=True)
class Thresholds:
    """Decision thresholds on the network's outputs. They belong to its weights and stand in its manifest."""

    drone: float
    """From this probability on, one picture alone shows a drone."""
    another_crop: float
    """A proposal with at most this probability is rejected without another crop."""
    mean_sigma: float
    """Error of the mean of a crop and its mirrored one, relative to that of a single crop."""
    min_log_range_sigma: float
    bearing_sigma_rad: float


@dataclass(frozen=True)
class SecondStage:
    """Interface of the second stage's networks."""

    crop_size: int
    """Width and height of its crops, pixels."""
    rules: CropSpec
    thresholds: Thresholds

    @classmethod
    def of(cls, manifest: Manifest, verification: Manifest | None = None) -> SecondStage:
        """The second stage from a distance network, and the verification network whose probability replaces its own.

        Raises ModelError if a manifest lacks the section `crop` or a threshold, or if the two take crops of different
        sizes.
        """
        judge = verification or manifest
        if judge.fixed_size != manifest.fixed_size:
            raise ModelError(
                f"perception.verification: model {judge.name} takes crops of another size than {manifest.name}; "
                "choose one that takes the same"
            )
        crop_size = manifest.crop_size_px
        assert manifest.crop is not None  # or it had no size
        return cls(
            crop_size=crop_size,
            rules=manifest.crop,
            thresholds=Thresholds(
                drone=judge.threshold("drone_probability"),
                another_crop=judge.threshold("another_crop_probability"),
                mean_sigma=manifest.threshold("mean_sigma_factor"),
                min_log_range_sigma=manifest.threshold("min_relative_sigma"),
                bearing_sigma_rad=manifest.threshold("bearing_sigma_rad"),
            ),
        )
