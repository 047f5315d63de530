"""Pictures of drones from a folder that may still be growing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.training import worlds
from tools.training.networks import MAX_FAMILIES
from tools.training.samples import Sample

_LOOK_EVERY = 200
"""Calls between two looks into the folder."""
_AIMED_SHARE = 0.6
"""At least so many of the drones are in the middle and fill their crop: the last crop of a drone is what counts."""
_NONE_SHARE = 0.08
"""Share of what is drawn that is no drone, however many families there are."""
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
                f"{self._folder}: no crops here; make them with `python -m tools.training.render_drone_crops`"
            )
        self._ends = np.cumsum([len(file["drone"]) for file in self._files.values()])
        family = np.concatenate([np.where(file["drone"] > 0.5, file["family"], -1) for file in self._files.values()])
        aimed = np.concatenate([is_aimed(file) for file in self._files.values()])
        names: NDArray[np.int64] = np.unique(family)
        self._of_family = [np.flatnonzero(family == one) for one in names]
        self._aimed_of_family = [np.flatnonzero((family == one) & aimed) for one in names]
        is_none, is_family = names == -1, (names >= 0) & (names < MAX_FAMILIES)
        of_drones = np.zeros(len(names))
        for which, of in ((is_family, 1 - worlds.SHAPES_SHARE), (~(is_none | is_family), worlds.SHAPES_SHARE)):
            of_drones[which] = of / max(1, int(np.count_nonzero(which)))
        drones = float(of_drones.sum())
        share = _NONE_SHARE if is_none.any() and drones > 0 else float(is_none.any())
        self._shares = np.where(is_none, share, (1 - share) * of_drones / max(drones, 1e-9))

    def draw(self, rng: np.random.Generator) -> Sample:
        """Any of them, and now and then what is none: every family as often as any other, however many crops there are
        of it, every shape as any other, and shapes together ``worlds.SHAPES_SHARE`` of the drones."""
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
