"""Single-frame detection in pictures of any origin: finding and reading them, detecting, scoring, drawing."""

from flockd.ground.pictures.picture_files import PictureFile, PictureLabels, find_pictures, read_labels
from flockd.ground.pictures.scoring import Labelled, summary
from flockd.ground.pictures.single_frame import DetectedDrone, PictureDetector, PictureResult, camera_with_fov

__all__ = [
    "DetectedDrone",
    "Labelled",
    "PictureDetector",
    "PictureFile",
    "PictureLabels",
    "PictureResult",
    "camera_with_fov",
    "find_pictures",
    "read_labels",
    "summary",
]
