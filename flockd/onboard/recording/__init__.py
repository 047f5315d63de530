"""Recording: inputs and outputs of a drone's pilot, in MCAP files that replay and viewers read."""

from flockd.onboard.recording.mcap_file import RecordingError
from flockd.onboard.recording.reader import RecordedStep, Recording
from flockd.onboard.recording.recorder import Recorder

__all__ = ["RecordedStep", "Recorder", "Recording", "RecordingError"]
