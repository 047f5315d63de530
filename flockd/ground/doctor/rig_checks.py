"""Whether the cameras are as configured, by what the last flight saw of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.core.errors import FlockdError
from flockd.flight.geometry import described, rig_faults
from flockd.ground.calibration.from_flight import found_rig
from flockd.ground.doctor.computer_checks import STATE_FOLDER
from flockd.ground.doctor.finding import Finding, failed, passed, warned
from flockd.onboard.recording.reader import Recording

ABOUT = "rig"


def check_rig(config: DroneConfig, folder: Path | None, state_folder: Path = STATE_FOLDER) -> Iterator[Finding]:
    """Of this drone's newest recording in the folder, named as for `check_disk`."""
    newest = _newest(config.name, folder or state_folder)
    if newest is None:
        yield passed(ABOUT, "no flight of this drone is recorded yet that its cameras could be compared with")
        return
    try:
        recording = Recording(newest)
        found = found_rig(recording)
    except (FlockdError, OSError) as error:
        yield warned(ABOUT, f"its last flight could not be read: {error}", "delete it, or recover it: flockd record")
        return
    if recording.config.rig != config.rig:
        yield passed(ABOUT, f"is another than in the last flight, {newest.name}, which says nothing of it")
        return
    if not found:
        yield passed(ABOUT, f"the last flight, {newest.name}, was too short to say anything of it")
        return
    off = [one for one in found if rig_faults(one)]
    for one in off:
        texts = "; ".join(fault.partition(": ")[2] for fault in rig_faults(one))
        about = f"camera {one.camera}"
        if one.elsewhere:
            fix = "look at `flockd cameras --picture`: then correct the rig, or how it is mounted or plugged in"
            yield failed(about, f"in the last flight {texts}", fix)
        else:
            fix = f"flockd calibrate rig --from-flight {newest} writes the corrected rig; see that the camera is fixed"
            yield warned(about, f"in the last flight {texts}: {described(one)}", fix)
    if not off:
        yield passed(ABOUT, f"the last flight, {newest.name}, saw {len(found)} cameras as they are configured")


def _newest(drone: str, folder: Path) -> Path | None:
    if not folder.is_dir():
        return None
    files = [path for path in folder.glob(f"{drone}-*.mcap") if path.is_file() and not path.is_symlink()]
    firsts = [path for path in files if path.name.count(".") == 1]
    return max(firsts, key=lambda path: path.stat().st_mtime, default=None)
