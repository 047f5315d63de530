"""What may make the outputs of a replay differ from those of the flight."""

from __future__ import annotations

from collections.abc import Iterator

from flockd.core.config import DroneConfig
from flockd.flight.inference.hashes import model_hashes
from flockd.onboard.recording.reader import Recording


def damage_warnings(recording: Recording) -> Iterator[str]:
    """One sentence for each damaged place and each gap of a recording."""
    contents = recording.contents
    for path, damage in contents.damages:
        where = "ends early" if damage.at_end else "is damaged"
        yield f"{path}: {where} at byte {damage.offset}: {damage.reason}"
    for first, last in contents.gaps:
        yield f"{recording.path}: steps {first} to {last} are missing, so that later outputs may differ"


def replay_warnings(recording: Recording, config: DroneConfig, start_s: float) -> Iterator[str]:
    """One sentence for each known reason why a replay from ``start_s`` with ``config`` may differ from the flight.

    ``start_s`` is on the recording's clock. Raises ModelError.
    """
    contents = recording.contents
    first_step = next(number for number, time_s in contents.steps if time_s >= start_s)
    if first_step > 0:
        yield f"the replay begins with step {first_step}: the pilot has no tracks and no flight time from before it"
    if contents.flight["images"] != "png":
        yield f"{recording.path}: its images are {contents.flight['images']}, which is lossy; outputs may differ"
    if contents.flight.get("true_roles"):
        yield f"{recording.path}: was flown with true {contents.flight['true_roles']}, and is replayed with networks"
    for name, sha256 in model_hashes(config.perception).items():
        recorded = contents.models.get(name)
        if recorded != sha256:
            flown = f"flew with {recorded[:12]}" if recorded else "flew without it"
            yield f"model {name} is {sha256[:12]} here, and the recording {flown}: outputs will differ"
