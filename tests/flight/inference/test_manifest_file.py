"""Reading a manifest never hangs, never fills memory, and always says where the fault is."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

import pytest

from flockd.core.errors import ModelError
from flockd.flight.inference import load_manifest
from flockd.flight.inference.manifest_file import read_manifest
from tests.flight.inference.foreign import one_channel_depth
from tests.hostile import ROOT, hostile, own_errors, put, text_of

pytestmark = pytest.mark.fault("hostile-manifest")

LIMIT_S = 2.0
"""Limit of the processor's time: what waits or reads for ever never ends, whatever else runs."""


@contextmanager
def refused(complaint: str) -> Iterator[None]:
    """In one sentence that matches, within the limit."""
    began_s = time.process_time()
    with pytest.raises(ModelError, match=complaint) as error:
        yield
    assert time.process_time() - began_s < LIMIT_S
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["FIFO", "device"])
def test_what_has_no_end_is_refused_without_waiting_for_it(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = one_channel_depth(tmp_path, output={})
    path.with_suffix(".onnx").unlink()
    make(path.with_suffix(".onnx"))
    with refused(rf"^{path}:4: file: .*not an ordinary file; "):
        load_manifest(path)
    path.unlink()
    make(path)
    with refused(rf"^{path}: .*not an ordinary file; "):
        read_manifest(path)


def test_a_model_file_larger_than_any_onnx_file_is_refused_unread_and_a_missing_one_at_its_key(tmp_path: Path) -> None:
    path = one_channel_depth(tmp_path, output={})
    with path.with_suffix(".onnx").open("wb") as stream:
        stream.truncate((2 << 30) + 1)  # sparse: it takes no room on the disk
    with refused(rf"^{path}:4: file: .* 2 GiB"):
        load_manifest(path)
    path.with_suffix(".onnx").unlink()
    with refused(rf"^{path}:4: file: .*someones_depth\.onnx \(No such file"):
        load_manifest(path)


def test_a_hostile_manifest_is_read_or_refused(tmp_path: Path) -> None:
    texts = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "models").glob("*.yaml"))]
    for name in {line.partition(": ")[2] for text in texts for line in text.splitlines() if line.startswith("file: ")}:
        (tmp_path / name).write_bytes(b"no network")
    file = tmp_path / "mutated.yaml"

    @hostile(25)
    def check(random: Random) -> None:
        put(random, file, lambda: text_of(random, texts))
        with own_errors():
            read_manifest(file).check_model()

    check()
