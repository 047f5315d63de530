"""Recording: inputs and outputs of a drone's pilot, in MCAP files that replay and viewers read."""

from flockd.recording.mcap_file import RecordingError
from flockd.recording.recorder import Recorder

__all__ = ["Recorder", "RecordingError"]
