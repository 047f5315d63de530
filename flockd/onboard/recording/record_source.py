"""The records of a recording, whatever holds them: an MCAP file of flockd, or a bag of ROS 2 that was made of one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from flockd.onboard.recording.bag_export import bag_records
from flockd.onboard.recording.mcap_file import Damage, Record, read_records
from flockd.onboard.recording.ros_bag import is_bag


def records_of(path: Path) -> Iterator[Record | Damage]:
    """All records in order. Raises RecordingError for what is neither, and OSError."""
    return bag_records(path) if is_bag(path) else read_records(path)
