"""Optical flow: a network, OpenCV's DIS, or the one after the other."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from flockd.inference.fitting import fit
from flockd.inference.session import OnnxModel
from flockd.messages import Float32Array, UInt8Array
from flockd.perception.landmarks import flow_of_landmarks
from flockd.perception.shift import flow_of_shift, likeness

_EXPLAINS = 0.8
"""Images that are less like each other than this along a flow say that it went astray: the camera moved too far."""

_STRIDE_PX, _DESCENTS, _VARIATIONS = 5, 12, 1
"""Of quick DIS."""


class Flow(Protocol):
    """Where every pixel of the first image has gone in the second."""

    name: str

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2) pixels right and down."""
        ...


class OnnxFlow:
    """A flow network; enters images as its manifest asks for."""

    def __init__(self, model: OnnxModel) -> None:
        self.name = model.manifest.name
        self._model = model

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """See ``Flow``."""
        height, width = first.shape[:2]
        fitting = fit(self._model.manifest, (width, height))
        answers = self._model.infer({"first": [fitting.enter(first)], "second": [fitting.enter(second)]})
        flow = np.moveaxis(fitting.inside(answers["flow"])[0], 0, 2) / np.array(fitting.scale, np.float32)
        full = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(full, dtype=np.float32)


class DisFlow:
    """OpenCV's dense inverse search (Kroeger et al. 2016): alone for small computers, or after another flow.

    It is exact to a fraction of a pixel where it converges, but loses what moves far; a network is the other way round.
    Where the network too loses its way, corners that look alike are tried as the start, then one shift of all.
    """

    def __init__(self, start: Flow | None = None, finest_scale: int = 1, *, quick: bool = False) -> None:
        """``start``: the flow to begin with at the coarsest scale; None: no motion.

        ``finest_scale``: it stops at a 2^n-th of the size. ``quick``: not OpenCV's medium preset, which errs by 0.16 px
        at the median in 34 ms, but fewer patches and less polish: 0.20 px in 12 ms, and lost more easily.
        """
        self.name = f"{start.name}+dis" if start else "dis"
        self._start = start
        self._finest_scale = finest_scale
        self._quick = quick

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """See ``Flow``."""
        before, after = _grey(first), _grey(second)
        if self._start is None:
            return self._from(np.zeros((*before.shape, 2), np.float32), before, after)
        best = self._from(self._start.flow(first, second), before, after)
        explained = likeness(before, after, best)
        for start_over in (flow_of_landmarks, flow_of_shift):
            if explained >= _EXPLAINS:
                break
            start = start_over(before, after)
            if start is None:
                continue
            other = self._from(start, before, after)
            explained, best = max((explained, best), (likeness(before, after, other), other), key=lambda pair: pair[0])
        return best

    def _from(self, start: Float32Array, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """The flow between grey images; ``start`` is changed."""
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # one a call: it is not for two threads
        dis.setFinestScale(self._finest_scale)
        if self._quick:
            dis.setPatchStride(_STRIDE_PX)
            dis.setGradientDescentIterations(_DESCENTS)
            dis.setVariationalRefinementIterations(_VARIATIONS)
        return np.asarray(dis.calc(first, second, start), dtype=np.float32)


def _grey(image: UInt8Array) -> UInt8Array:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
