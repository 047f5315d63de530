"""Optical flow by OpenCV's DIS, from no motion or from another flow on."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.perception.flow.cross_correlation import flow_correlation, translation_flow
from flockd.flight.perception.flow.features import feature_flow
from flockd.flight.perception.flow.images import grey
from flockd.flight.perception.interface import Flow


class DisFlow:
    """OpenCV's dense inverse search (Kroeger et al. 2016): alone for small computers, or after another flow.

    It is exact to a fraction of a pixel where it converges, but loses what moves far; a network is the other way round.
    Where the network fails too, matched features are tried as the start, then one translation of the whole image.
    """

    def __init__(
        self, start: Flow | None = None, finest_scale: int = 1, *, when_lost: bool = False, min_correlation: float = 0.8
    ) -> None:
        """``start``: the flow to begin with at the coarsest scale; None: no motion.

        ``finest_scale``: it stops at a 2^n-th of the size. ``when_lost``: the start's flow is taken as it is, but where
        the images correlate by less than ``min_correlation`` along it; there other starts are tried.
        """
        self.name = start.name if start and when_lost else f"{start.name}+dis" if start else "dis"
        self._start = start
        self._finest_scale = finest_scale
        self._when_lost, self._min_correlation = when_lost, min_correlation
        self._idle: list[cv2.DISOpticalFlow] = []
        """None is for two callers at once. Each keeps its memory, which to take anew costs a third of its time."""

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """See `Flow`."""
        before, after = grey(first), grey(second)
        if self._start is None:
            return self._refined(np.zeros((*before.shape, 2), np.float32), before, after)
        best = self._start.flow(first, second)
        if not self._when_lost:
            best = self._refined(best, before, after)
        correlation = flow_correlation(before, after, best)
        for other_start in (feature_flow, translation_flow):
            if correlation >= self._min_correlation:
                break
            start = other_start(before, after)
            if start is None:
                continue
            other = self._refined(start, before, after)
            other_correlation = flow_correlation(before, after, other)
            if other_correlation > correlation:
                correlation, best = other_correlation, other
        return best

    def _refined(self, start: Float32Array, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """The flow between grey images; ``start`` is changed."""
        dis = self._idle.pop() if self._idle else self._made()
        try:
            return np.asarray(dis.calc(first, second, start), dtype=np.float32)
        finally:
            self._idle.append(dis)

    def _made(self) -> cv2.DISOpticalFlow:
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        dis.setFinestScale(self._finest_scale)
        return dis
