"""Optical flow of all pixels: by a network, and by OpenCV's DIS, from no motion or from another flow on."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.inference.fitting import fit
from flockd.flight.inference.session import OnnxModel
from flockd.flight.perception.flow.lucas_kanade import grey
from flockd.flight.perception.interface import Flow


class DisFlow:
    """OpenCV's dense inverse search (Kroeger et al. 2016): alone for small computers, or after another flow.

    It is exact to a fraction of a pixel where it converges, but loses what moves far; a network is the other way round.
    """

    def __init__(self, start: Flow | None = None, finest_scale: int = 1) -> None:
        """``start``: the flow to begin with at the coarsest scale; None: no motion.

        ``finest_scale``: it stops at a 2^n-th of the size.
        """
        self.name = f"{start.name}+dis" if start else "dis"
        self._start = start
        self._finest_scale = finest_scale
        self._idle: list[cv2.DISOpticalFlow] = []
        """None is for two callers at once. Each keeps its memory, which to take anew costs a third of its time."""

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """See `Flow`."""
        before, after = grey(first), grey(second)
        start = np.zeros((*before.shape, 2), np.float32) if self._start is None else self._start.flow(first, second)
        dis = self._idle.pop() if self._idle else self._made()
        try:
            return np.asarray(dis.calc(before, after, start), dtype=np.float32)
        finally:
            self._idle.append(dis)

    def _made(self) -> cv2.DISOpticalFlow:
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        dis.setFinestScale(self._finest_scale)
        return dis


class OnnxFlow:
    """A flow network; enters images as its manifest asks for."""

    def __init__(self, model: OnnxModel) -> None:
        self.name = model.manifest.name
        self._model = model

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """See `Flow`."""
        height, width = first.shape[:2]
        fitting = fit(self._model.manifest, (width, height))
        outputs = self._model.infer({"first": [fitting.enter(first)], "second": [fitting.enter(second)]})
        flow = fitting.inside(outputs["flow"])[0].transpose(1, 2, 0) / np.array(fitting.scale, np.float32)
        full = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(full, dtype=np.float32)
