"""Dense optical flow: by a network, or by OpenCV's DIS, which may start from another flow."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.inference.fitting import fit
from flockd.flight.inference.session import OnnxModel
from flockd.flight.perception.flow.lucas_kanade import grey


class DisFlow:
    """OpenCV's dense inverse search (Kroeger et al. 2016): alone on small computers, or after another flow.

    It is exact to a fraction of a pixel if it converges, but loses large motions; a network is the opposite.
    """

    def __init__(self, start: OnnxFlow | None = None) -> None:
        """``start``: the flow that initialises the coarsest scale; None: no motion."""
        self._start = start
        self._idle: list[cv2.DISOpticalFlow] = []
        """Instances not in use: none serves two callers at once. Reusing one's memory saves a third of the time."""

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2): the displacement of each pixel of the first image, right and down."""
        before, after = grey(first), grey(second)
        start = np.zeros((*before.shape, 2), np.float32) if self._start is None else self._start.flow(first, second)
        dis = self._idle.pop() if self._idle else cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        try:
            return np.asarray(dis.calc(before, after, start), dtype=np.float32)
        finally:
            self._idle.append(dis)


class OnnxFlow:
    """A flow network; scales images as its manifest asks."""

    def __init__(self, model: OnnxModel) -> None:
        self._model = model

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2): the displacement of each pixel of the first image, right and down."""
        height, width = first.shape[:2]
        fitting = fit(self._model.manifest, (width, height))
        outputs = self._model.infer({"first": [fitting.enter(first)], "second": [fitting.enter(second)]})
        flow = fitting.inside(outputs["flow"])[0].transpose(1, 2, 0) / np.array(fitting.scale, np.float32)
        full = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(full, dtype=np.float32)
