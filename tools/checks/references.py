"""Write the expected outputs of the four recorded flights that the fast tests replay, as after a change of networks.

    python -m tools.checks.references

- ``normal``: three drones on their way.
- ``crossing``: five drones fly through one another's images, 1 to 4 m away.
- ``fisheye``: as ``normal``, with the fisheyes of `config/quadrotor.yaml`, as bad as real ones.
- ``faults``: a camera lost, a black image, a torn one, a time stamp twice, one that goes back, a second of nothing.

The recordings stay as they are; `tools.checks.record_regressions` of commit 7b9dec37 flew them. They are replayed with
the networks in 32-bit floats, in place of those in 8 bits that they were flown with: with and without VNNI
instructions, processors compute the latter differently.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import yaml

from flockd.cli import main as flockd
from flockd.onboard.recording.reader import Recording

FOLDER = Path(__file__).parents[2] / "tests" / "review" / "replay"
FLIGHTS = ("normal", "crossing", "faults", "fisheye")


def main() -> None:
    """Replays each, and writes its reference."""
    for name in FLIGHTS:
        recording, reference = FOLDER / f"{name}.mcap", FOLDER / f"{name}.expected"
        with tempfile.TemporaryDirectory() as folder:
            config = with_float_networks(recording, Path(folder) / "drone.yaml")
            update = ["--config", str(config), "--reference", str(reference), "--update-reference"]
            if flockd(["replay", str(recording), *update]):
                raise SystemExit(f"{recording}: could not be replayed")
        print(f"{reference}: {reference.stat().st_size / 1e3:.0f} kB")


def with_float_networks(recording: Path, target: Path) -> Path:
    """Writes the recording's configuration to the target, each 8-bit network replaced by the one it was made from."""
    document = json.loads(Recording(recording).config.model_dump_json())
    document["perception"] = {
        key: value.removesuffix("_int8") if isinstance(value, str) else value
        for key, value in document["perception"].items()
    }
    target.write_text(yaml.safe_dump(document), encoding="utf-8")
    return target


if __name__ == "__main__":
    main()
