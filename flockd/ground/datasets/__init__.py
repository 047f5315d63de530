"""Images that others took with real cameras, in folders with depth and poses: read, and flown again."""

from flockd.ground.datasets.dataset import Dataset, DatasetFrame
from flockd.ground.datasets.errors import DatasetError
from flockd.ground.datasets.image_folder import open_dataset

__all__ = ["Dataset", "DatasetError", "DatasetFrame", "open_dataset"]
