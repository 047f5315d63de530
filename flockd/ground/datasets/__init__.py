"""Images that others took with real cameras, in folders with depth and poses: read, and flown again."""

from flockd.ground.datasets.image_files import DatasetError
from flockd.ground.datasets.image_folder import Dataset, DatasetFrame, open_dataset

__all__ = ["Dataset", "DatasetError", "DatasetFrame", "open_dataset"]
