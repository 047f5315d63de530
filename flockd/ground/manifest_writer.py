"""Writes the manifest of a model file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from numpy.typing import NDArray

from flockd.flight.inference import OnnxModel


def write_manifest(document: dict[str, Any], file: Path, golden: Mapping[str, NDArray[Any]]) -> Path:
    """Writes the manifest of a model ``file`` beside it, with its hash and its ``golden`` outputs. Returns its path.

    Opens the model once, as flockd does. Raises ModelError.
    """
    document["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    for name, value in golden.items():
        document["outputs"][name] |= {"golden_mean": float(value.mean()), "golden_deviation": float(value.std())}
    path = write_unchecked(document, file)
    OnnxModel(path, threads=1)
    return path


def write_unchecked(document: dict[str, Any], file: Path) -> Path:
    """Writes ``document`` beside ``file`` without a check. Returns its path."""
    path = file.with_suffix(".yaml")
    path.write_text(yaml.dump(document, Dumper=WithoutAliases, sort_keys=False, width=110), encoding="utf-8")
    return path


class WithoutAliases(yaml.SafeDumper):
    """Writes a list that two keys share twice, because manifests may not have anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        """True for every value."""
        return True
