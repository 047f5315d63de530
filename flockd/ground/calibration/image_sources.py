"""Images to calibrate with: from a folder, a recording or a live camera, and the camera's identity."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.core.errors import UnavailableError
from flockd.core.messages import UInt8Array
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.datasets.image_files import SUFFIXES, read_image
from flockd.onboard.recording.reader import Recording
from flockd.onboard.sources import FrameSource, open_source

MOST_S = 120.0
"""Of a live camera."""
FIRST_FRAME_S = 10.0
FRAME_WAIT_S = 0.2
SYSFS = Path("/sys/class/video4linux")


@dataclass(frozen=True, eq=False)
class ImageSet:
    """What several cameras saw at one time."""

    name: str
    images: Mapping[str, UInt8Array]
    """(h, w, 3) RGB by camera."""


@dataclass(frozen=True, eq=False)
class ImageStream:
    """Sets of images, one after the other."""

    sets: Iterator[ImageSet]
    count: int
    """How many there are about; 0 for a live camera."""
    live: bool
    identities: Mapping[str, str]
    """What identifies each camera: its serial number where it has one."""


def from_folder(path: Path, camera: str) -> ImageStream:
    """All images of a folder, by name, as those of one camera. Raises CalibrationError where there are none."""
    files = _images(path)
    if not files:
        raise CalibrationError(f"{path}: has no images; name the folder they are in")
    sets = (ImageSet(file.name, {camera: read_image(file)}) for file in files)
    return ImageStream(sets, len(files), live=False, identities={camera: f"not known (images in {path.name})"})


def from_folders(path: Path, cameras: Sequence[str]) -> ImageStream:
    """A folder for each camera within one; images of the same name were taken at the same time."""
    missing = [camera for camera in cameras if not (path / camera).is_dir()]
    if missing:
        raise CalibrationError(
            f"{path / missing[0]}: is no folder; make one for each camera of the rig, with its images"
        )
    files = {camera: {file.stem: file for file in _images(path / camera)} for camera in cameras}
    names = sorted({name for of_camera in files.values() for name in of_camera})
    if not names:
        raise CalibrationError(f"{path}: has no images in its cameras' folders")
    sets = (
        ImageSet(name, {camera: read_image(found[name]) for camera, found in files.items() if name in found})
        for name in names
    )
    identities = {camera: f"not known (images in {path.name}/{camera})" for camera in cameras}
    return ImageStream(sets, len(names), live=False, identities=identities)


def from_recording(recording: Recording, every: int) -> tuple[ImageStream, DroneConfig]:
    """Every ``every``-th step of a recording, and the configuration in it. Reading raises RecordingError."""
    config = recording.config
    sets = (
        ImageSet(
            f"{step.frames.time_s - recording.start_s:.2f} s",
            {name: frame.image for name, frame in step.frames.frames.items()},
        )
        for step in recording.steps()
        if step.number % every == 0
    )
    places = {} if config.source is None else {camera.name: f", {camera.place}" for camera in config.source.cameras}
    identities = {
        camera.name: camera.intrinsics.measured.camera
        if camera.intrinsics.measured
        else f"not known ({camera.name} of {recording.drone}{places.get(camera.name, '')})"
        for camera in config.rig.cameras
    }
    return ImageStream(sets, -(-len(recording.contents.steps) // every), live=False, identities=identities), config


def from_cameras(config: DroneConfig, file: str, enough: Callable[[], bool]) -> ImageStream:
    """Frames of a drone's live cameras, until it is enough, the time is up or Ctrl-C. Raises ConfigError.

    Reading raises UnavailableError when no frame comes.
    """
    source = open_source(config, file)
    cameras = () if config.source is None else config.source.cameras
    devices = {camera.name: camera.device for camera in cameras if camera.device}
    identities = {
        camera.name: identity(Path(devices[camera.name])) if camera.name in devices else f"not known ({camera.name})"
        for camera in config.rig.cameras
    }
    return ImageStream(_frames(source, enough), 0, live=True, identities=identities)


def identity(device: Path, sysfs: Path = SYSFS) -> str:
    """What identifies a camera: vendor, product and serial number of a USB camera, else its name and device."""
    entry = sysfs / device.resolve().name
    usb = (entry / "device").resolve().parent
    vendor, product, serial = (_text(usb / name) for name in ("idVendor", "idProduct", "serial"))
    if vendor and product:
        return f"USB {vendor}:{product} {f'serial {serial}' if serial else f'without a serial number, {device}'}"
    return f"{_text(entry / 'name') or 'not known'}, {device}"


def with_one_camera(config: DroneConfig, name: str) -> DroneConfig:
    """The same drone with one camera."""
    rig = config.rig.model_copy(update={"cameras": tuple(one for one in config.rig.cameras if one.name == name)})
    source = config.source
    if source is not None and source.cameras:
        source = source.model_copy(update={"cameras": tuple(one for one in source.cameras if one.name == name)})
    return config.model_copy(update={"rig": rig, "source": source})


def _frames(source: FrameSource, enough: Callable[[], bool]) -> Iterator[ImageSet]:
    source.start()
    began_s, seen = time.monotonic(), False
    try:
        while (since_s := time.monotonic() - began_s) < MOST_S and not enough():
            frames = source.newest(FRAME_WAIT_S)
            if frames is not None:
                seen = True
                yield ImageSet(f"{since_s:.1f} s", {name: one.image for name, one in frames.frames.items()})
            elif not seen and since_s > FIRST_FRAME_S:
                break
        if not seen:
            faults = [status.fault for status in source.status().values() if status.fault]
            raise UnavailableError(faults[0] if faults else "no camera gave a frame; check how it is plugged in")
    finally:
        source.stop()


def _images(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
