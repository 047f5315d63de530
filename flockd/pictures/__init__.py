"""Single-frame detection in pictures of any origin: finding and reading them, detecting, scoring, drawing."""

from flockd.pictures.coco_labels import PictureLabels, read_labels
from flockd.pictures.picture_files import PictureFile, find_pictures
from flockd.pictures.scoring import Labelled, summary
from flockd.pictures.single_frame import DetectedDrone, PictureDetector, PictureResult, camera_with_fov

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
