"""Pictures of drones from a folder that may still be growing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.training.samples import Sample

_LOOK_EVERY = 200
"""Calls between two looks into the folder."""
_AIMED_SHARE = 0.6
"""At least so many of the drones are in the middle and fill their crop: the last crop of a drone is what counts."""
_NONE_SHARE = 0.08
"""Of what is drawn: what is no drone, however many families there are."""
_AIMED_OFF_PX, _AIMED_PX = 4.0, (60.0, 84.0)


class CropFiles:
    """Every sample of every file of ``render_drone_crops.py``, in memory."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[Path, Sample] = {}
        self._ends = np.zeros(0, np.int64)
        self._of_family: list[NDArray[np.int64]] = []
        self._aimed_of_family: list[NDArray[np.int64]] = []
        self._calls = 0
        self.look_for_more()

    def look_for_more(self) -> None:
        """Take up files that have appeared; looks only now and then."""
        self._calls += 1
        if self._calls % _LOOK_EVERY != 1:
            return
        for path in sorted(self._folder.glob("*.npz")):
            if path not in self._files:
                with np.load(path) as arrays:
                    self._files[path] = dict(arrays)
                if "mask" not in self._files[path]:
                    raise ValueError(f"{path}: its crops have no masks; make the folder anew")
        if not self._files:
            raise FileNotFoundError(
                f"{self._folder}: no crops here; make them with `python -m tools.render_drone_crops`"
            )
        self._ends = np.cumsum([len(file["drone"]) for file in self._files.values()])
        family = np.concatenate([np.where(file["drone"] > 0.5, file["family"], -1) for file in self._files.values()])
        aimed = np.concatenate([is_aimed(file) for file in self._files.values()])
        names = np.unique(family)
        self._of_family = [np.flatnonzero(family == one) for one in names]
        self._aimed_of_family = [np.flatnonzero((family == one) & aimed) for one in names]
        none = names == -1
        share = _NONE_SHARE if none.any() and not none.all() else float(none.all())
        self._shares = np.where(none, share, (1 - share) / max(1, int(np.count_nonzero(~none))))

    def draw(self, rng: np.random.Generator) -> Sample:
        """Any of them: every family as often, however many crops there are of it, and now and then what is none."""
        one = int(rng.choice(len(self._shares), p=self._shares))
        rows = self._of_family[one]
        if rng.random() < _AIMED_SHARE and len(self._aimed_of_family[one]):
            rows = self._aimed_of_family[one]
        index = int(rows[int(rng.integers(len(rows)))])
        which = int(np.searchsorted(self._ends, index, side="right"))
        file = list(self._files.values())[which]
        row = index - int(self._ends[which])
        return {name: values[row] for name, values in file.items()}


def is_aimed(file: Sample) -> NDArray[np.bool_]:
    """(n,) which crops of a file show their drone as a cascade's last crop does: in the middle, and filling it."""
    low, high = np.log(_AIMED_PX)
    off = np.linalg.norm(file["target"][:, 1:3], axis=1)
    return np.asarray((off < _AIMED_OFF_PX) & (low < file["apparent"]) & (file["apparent"] < high))
