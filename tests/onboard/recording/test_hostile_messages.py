"""What is damaged or hostile inside a message, behind correct checksums, found by changing records at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from flockd.onboard.recording import RecordingError
from flockd.onboard.recording.mcap_file import Entry, Record
from flockd.onboard.recording.reader import Recording
from tests.onboard.recording.made_up import record, rewritten

pytestmark = pytest.mark.fault("hostile-recording")

STEPS = 3
DEEP = b"[" * 100_000


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "drone1.mcap"
    record(path, STEPS)
    return path


def changed(whole: Path, path: Path, topic: str, change: Callable[[Entry], Entry], step: int = 1) -> Path:
    """A copy with one message changed, all checksums right."""

    def in_its_step(found: Record) -> Record:
        hit = isinstance(found, Entry) and found.stream.topic == topic and found.sequence == step
        return change(found) if hit else found  # type: ignore[arg-type]

    return rewritten(whole, path, in_its_step)


@pytest.mark.parametrize("topic", ["/vehicle", "/output"])
@pytest.mark.parametrize(
    "data", [b"", b"{", b"\xff", b"[1]", b'"x"', DEEP], ids=["none", "open", "utf8", "list", "text", "deep"]
)
def test_a_step_with_a_damaged_message_is_named(tmp_path: Path, whole: Path, topic: str, data: bytes) -> None:
    path = changed(whole, tmp_path / "x.mcap", topic, lambda entry: replace(entry, data=data))
    if (topic, data) not in {("/output", b"[1]"), ("/output", b'"x"')}:  # an output is only compared, not flown
        with pytest.raises(RecordingError, match="step 1 cannot be read "):
            list(Recording(path).steps())
