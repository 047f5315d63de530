"""Optical flow by a network."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.inference.fitting import fit
from flockd.flight.inference.session import OnnxModel


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
        flow = np.moveaxis(fitting.inside(outputs["flow"])[0], 0, 2) / np.array(fitting.scale, np.float32)
        full = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(full, dtype=np.float32)
