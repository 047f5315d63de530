"""What each role needs of a manifest, held against the shipped ones and against ones that lack something."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.core.choices import ROLES
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.core.errors import ModelError
from flockd.flight.inference import find_manifests, manifests_of, read_manifest
from flockd.flight.perception.requirements import REQUIREMENTS, check_roles
from tests.flight.inference.foreign import one_channel_depth, write_manifest

MODELS = data_path("models")
Change = Callable[[dict[str, Any]], object]


def changed(folder: Path, name: str, change: Change) -> Path:
    """A shipped manifest with something changed."""
    document = yaml.safe_load((MODELS / f"{name}.yaml").read_text())
    change(document)
    path = folder / f"{name}.yaml"
    write_manifest(path, document)
    return path


@pytest.mark.parametrize("path", find_manifests(MODELS), ids=lambda path: path.stem)
def test_the_shipped_manifests_fill_their_roles(path: Path) -> None:
    assert read_manifest(path, check_roles).manifest.roles


def test_each_role_of_the_configuration_has_its_requirements() -> None:
    assert tuple(REQUIREMENTS) == ROLES
    config = PerceptionConfig()
    assert config.networks == {role: getattr(config, role) for role in ROLES}
    without = PerceptionConfig(flow="dis", distance="none")
    assert list(without.networks) == ["depth", "segmentation"]
    assert [path.stem for path in manifests_of(without)] == ["neighbours_int8"]


def without(section: str, key: str) -> Change:
    return lambda document: document[section].pop(key)


@pytest.mark.parametrize(
    ("name", "change", "complaint"),
    [
        ("flow", lambda d: d.update(roles=["stereo"]), r":3: roles\[0\]: stereo is not a role; the roles are flow"),
        ("flow", lambda d: d.update(roles=["depth"]), r"inputs: the role depth needs one that carries 'image'"),
        ("flow", lambda d: d["outputs"]["flow"].update(gives="motion"), r"outputs: the role flow needs one that gives"),
        ("flow", lambda d: d.update(thresholds={"p": 1.0}), r"thresholds\.p: is not a threshold of its roles; del"),
        ("distance", lambda d: d.pop("crop"), r"yaml:1: crop: is missing for the role distance; add a section"),
        ("distance", without("thresholds", "drone_probability"), r"thresholds\.drone_probability: is missing for"),
        (
            "distance", lambda d: d["thresholds"].update(drone_probability=80),
            r"yaml:\d+: thresholds\.drone_probability: 80 is out of range; write a number from 0 to 1",
        ),
        (
            "distance", lambda d: d["thresholds"].update(sure=0.5),
            r"yaml:\d+: thresholds\.sure: is not a threshold of its roles; delete it, or write one of drone",
        ),
        (
            "distance", lambda d: d["outputs"]["range"]["columns"].__setitem__(2, "up_px"),
            r"yaml:\d+: outputs\.range\.columns: has no 'down_px'; name the model's columns in their order",
        ),
        ("distance", lambda d: d["inputs"]["picture"].pop("carries"), r"inputs: the role distance needs one .* 'crop'"),
        (
            "verification", without("thresholds", "distance_logit_limit"),
            r"thresholds\.distance_logit_limit: is missing for the role verification; add it with",
        ),
        (
            "verification", lambda d: d["outputs"]["drone"].update(columns=["sure"]),
            r"yaml:\d+: outputs\.drone\.columns: has no 'drone_logit'",
        ),
        ("neighbours", lambda d: d.pop("map_stride"), r"map_stride: is missing; write how many image pixels"),
        ("neighbours", lambda d: d["inputs"]["geometry"].pop("kind"), r"inputs\.geometry\.shape\[3\]: w/2 is not the"),
        (
            "neighbours", lambda d: d["inputs"]["geometry"].update(carries="sound"),
            r"yaml:\d+: inputs\.geometry: nothing is known to feed 'sound' with; set `carries` to one of geometry",
        ),
        (
            "neighbours", lambda d: d["thresholds"].update(mask_logit=51.0),
            r"yaml:\d+: thresholds\.mask_logit: 51 is out of range; write a number from -50 to 50",
        ),
    ],
)  # fmt: skip
def test_what_a_role_lacks_is_one_sentence_with_file_line_and_key(
    tmp_path: Path, name: str, change: Change, complaint: str
) -> None:
    path = changed(tmp_path, name, change)
    with pytest.raises(ModelError, match=complaint) as refused:
        read_manifest(path, check_roles)
    assert str(refused.value).startswith(f"{path}:")
    assert "\n" not in str(refused.value)


def test_a_depth_network_needs_no_stride_no_crop_and_no_thresholds(tmp_path: Path) -> None:
    manifest = read_manifest(one_channel_depth(tmp_path, output={}), check_roles).manifest
    assert (manifest.map_stride, manifest.crop, manifest.thresholds) == (None, None, {})
