"""Decides whether a camera's image is used: not noise, consistent with the image before, and the ground is clear.

Each image is reduced once: to the strength of its details of 2 to 16 pixels in blocks, by the diagonal details of an
orthonormal Haar transform, and to a small grey image. Both are compared with the camera's earlier images, and with
those of the rig's other cameras at the same moment.

Noise: white noise is as strong at each scale, while scenes lose their contrast from scale to scale. The power spectrum
of photographs falls with the square of the frequency (Field 1987, Ruderman and Bialek 1994), so the details are about
half as strong at the finest scale as at the next. The finest scale alone (Donoho and Johnstone 1994, Immerkaer 1996) is
not enough: grass and leaves are as strong there as noise. Filtered noise, as from a camera's electronics, has the
spectrum of gravel, but it appears at once and everywhere, while a drone's view changes slowly.

Continuity: the last image, moved along the optical flow, explains the next one, whatever its texture. Noise and damaged
blocks are new in each image. The unexplained share also depends on the drone's motion, which all cameras share: one is
compared with the others while the drone turns slowly. A single camera is not judged.

Lens: a cover, dirt, fog and sun reduce contrast or sharpness for a long time. Sky has neither, so only blocks that look
at the ground count. Plain ground, dusk and mist reduce them in all cameras. Local contrast and the share of it at a
finer scale are usual measures of quality (S. Pertuz et al., "Analysis of focus measure operators for shape-from-focus",
Pattern Recognition 46(5), 2013). Contrast is a share of the brightness (E. Peli, "Contrast in complex images", JOSA A
7(10), 1990): asphalt beside gravel is darker as well as smoother, while a veil of fog or stray light is bright.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import Float32Array, FloatArray, Reason, ReasonKind, UInt8Array
from flockd.flight.geometry import RigCamera

_BLOCK_PX = 32
_SIGMA_PER_MEAN = math.sqrt(math.pi / 2)
"""Standard deviation over mean magnitude of a normal distribution."""
_FORGOTTEN_S = 2.0
"""Longest gap between images of a camera that are compared; after it the view may be entirely different."""
_FADES_S = 30.0
"""Time constant of the noisiest view of a camera: gravel that a wall hid for a while is not noise."""

_LONGER_SIDE_PX = 96
"""Longer side of the small images that are compared: pixel noise averages out, and DIS takes a millisecond."""
_PATCH_PX = 8
_WINDOW_PX = 15
"""Side of the windows of the comparison, so that a damaged block has contrast in each window that contains it."""
_MIN_CONTRAST, _MIN_CORRELATION = 10.0, 0.7
"""Two windows differ if both have this contrast (standard deviation in grey levels) and correlate less than this."""
_MAX_TURN = math.radians(10.0)
"""Largest turn of the drone between two images; beyond it the flow fails, in some cameras before others."""

_BELOW_RAD = math.radians(10.0)
"""Angle below the horizon from which a block shows ground, over hills too."""
_LEAST_BLOCKS, _QUANTILE = 12, 0.75
"""Fewest ground blocks that are judged, and the quantile that is compared: a plain wall takes the contrast from some
blocks, a bad lens from all."""
_DARK = 32.0
"""Grey levels added to the brightness, so that a camera's noise under a dark cover is not contrast."""
_FAINTEST = 0.004
"""Contrast of a camera's noise; the sharpness of ground with less is not judged."""
_REMEMBERED_S, _KNOWN_S = 300.0, 10.0
"""Time over which a camera's usual clarity is averaged. While it is known for less than the second number of seconds,
only images that lost more show a bad lens: the limit grows from 0."""
_LASTS_S, _LEAST_IMAGES = 2.0, 3
"""Time and images for which a lens has to be bad, or good again, before it counts: a gust turns a camera briefly."""
_ALL_LOST = 0.1
"""If the other cameras keep no more of their contrast, as after a landing in grass, no lens is judged."""
_GOOD_AGAIN = 1.25
"""Factor on the limit of a lens that was bad."""


class Shown(NamedTuple):
    """One image, reduced."""

    white: float
    """Share of blocks, 0 to 1, with strong fine details that are not much weaker than those twice the size."""
    rough: float
    """Share of blocks in which the details of one of the three scales are very strong."""
    clarity: FloatArray | None
    """(2,) contrast of the ground, a share of its brightness, and sharpness, a share of its contrast; None: too little
    ground is in view."""
    small: UInt8Array
    """Grey, with `_LONGER_SIDE_PX` along the longer side."""


def shown_in(image: UInt8Array, parameters: NoiseParameters, downwards: FloatArray) -> Shown:
    """Reduces an RGB image (h, w, 3).

    Args:
        image: of any size; one smaller than a block only gives the small image.
        parameters: of the configuration.
        downwards: (rows, columns) sine of each block's angle below the horizon; NaN outside the lens's image.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    shrink, (rows, columns) = _LONGER_SIDE_PX / max(grey.shape), downwards.shape
    size = max(round(shrink * grey.shape[1]), 1), max(round(shrink * grey.shape[0]), 1)
    small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    if not downwards.size:
        return Shown(0.0, 0.0, None, small)
    rest = np.asarray(grey[: rows * _BLOCK_PX, : columns * _BLOCK_PX], np.float32)
    sigmas = []
    for scale in (1.0, 2.0, 4.0, 8.0):
        difference = cv2.subtract(rest[0::2], rest[1::2])
        details = cv2.absdiff(difference[:, 0::2], difference[:, 1::2])
        sigmas.append(
            0.5 * scale * _SIGMA_PER_MEAN * cv2.resize(details, (columns, rows), interpolation=cv2.INTER_AREA)
        )
        rest = np.asarray(cv2.resize(rest, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32)
    fine, middle, coarse, coarsest = sigmas
    strong = parameters.rough_level
    white = (fine > parameters.level) & (fine > parameters.whiteness * middle)
    rough = (fine > strong) | (middle > strong) | (coarse > 1.5 * strong)
    ground, clarity = downwards > math.sin(_BELOW_RAD), None
    number = np.count_nonzero(ground)
    if number >= _LEAST_BLOCKS:
        brightness = _DARK + cv2.resize(rest, (columns, rows), interpolation=cv2.INTER_AREA)
        shares = np.array([coarsest, middle]) / brightness
        contrast, detail = np.sort(shares[:, ground], axis=1)[:, int(_QUANTILE * number)].tolist()
        clarity = np.array([contrast, detail / max(contrast, _FAINTEST)])
    return Shown(np.count_nonzero(white) / white.size, np.count_nonzero(rough) / rough.size, clarity, small)


class _Fault(Enum):
    """Why an image is not used."""

    NOISE = "its image is noise"
    DAMAGE = "its image does not follow from the one before"
    LENS = "its lens is covered, dirty, fogged or in the sun, by the contrast of the ground"

    def reason(self, camera: str) -> Reason:
        kind = ReasonKind.LENS if self is _Fault.LENS else ReasonKind.CAMERA
        return Reason(kind, f"camera {camera}: {self.value}")


@dataclass
class _Camera:
    """The monitor's state of one camera."""

    rays: FloatArray
    """(rows, columns, 3) unit vectors in body axes through the blocks' centres; NaN outside the lens's image."""
    time_s: float = -math.inf
    """Time of its last image."""
    last: UInt8Array | None = None
    """The last small image; None after noise."""
    used_s: float = -math.inf
    """Time of the last image that was used."""
    noisiest: FloatArray | None = None
    """(2,) fading maxima of the shares of white and of rough blocks in images that were used."""
    usual: FloatArray | None = None
    """(2,) mean clarity of images that were used."""
    remembered_s: float = 0.0
    """Time over which `usual` was averaged."""
    fault: _Fault | None = None
    since_s: float = math.inf
    """Since when its images contradict its current verdict."""
    images: int = 0
    """Number of those images."""


class ImageMonitor:
    """Decides which images of a rig's cameras are not used."""

    def __init__(self, cameras: Mapping[str, RigCamera], parameters: NoiseParameters) -> None:
        self._parameters = parameters
        self._cameras = {
            name: _Camera(camera.camera.block_rays(_BLOCK_PX) @ camera.T_body_camera.rotation.T)
            for name, camera in cameras.items()
        }
        self._R_ned_body: FloatArray = np.eye(3)
        self._time_s = -math.inf

    def faults(self, images: Mapping[str, UInt8Array], time_s: float, R_ned_body: FloatArray) -> dict[str, Reason]:
        """Cameras whose newest images are not used, and why; to be called once for each moment.

        After noise or damage, images are refused until some in a row are clean.

        Args:
            images: RGB images (h, w, 3) of one moment, by camera, of the rig's sizes.
            time_s: their time.
            R_ned_body: (3, 3) the drone's attitude then.
        """
        turns = float(np.vdot(self._R_ned_body, R_ned_body)) < 1.0 + 2.0 * math.cos(_MAX_TURN)  # by the trace
        before_s, self._R_ned_body, self._time_s = self._time_s, R_ned_body, time_s
        shown, verdicts, unexplained = {}, dict[str, _Fault | None](), {}
        for name, image in images.items():
            camera = self._cameras[name]
            now = shown[name] = shown_in(image, self._parameters, camera.rays @ R_ned_body[2])
            if not 0.0 <= time_s - camera.time_s <= _FORGOTTEN_S:
                camera.last, camera.noisiest, camera.since_s, camera.images = None, None, math.inf, 0
            elif time_s - camera.used_s > _FADES_S:
                camera.noisiest = None
            verdicts[name] = _Fault.NOISE if self._is_noise(now, camera) else None
            # After a rest the drone may have turned further, and the scene changes more than that of other cameras.
            if camera.last is not None and camera.time_s == before_s and not (verdicts[name] or turns):
                unexplained[name] = unexplained_share(camera.last, now.small)
            camera.last = None if verdicts[name] else now.small
        for name, share in unexplained.items():
            others = [other for camera, other in unexplained.items() if camera != name]
            if others and share - median(others) > self._parameters.max_unexplained:
                verdicts[name] = _Fault.DAMAGE
        kept = {name: self._kept(now, self._cameras[name]) for name, now in shown.items() if not verdicts[name]}
        for name, own in kept.items():
            others = [other for camera, other in kept.items() if camera != name and other is not None]
            counts_as_bad = self._cameras[name].fault is _Fault.LENS
            limit = self._parameters.min_clarity * (_GOOD_AGAIN if counts_as_bad else 1.0)
            limit *= min(self._cameras[name].remembered_s / _KNOWN_S, 1.0)
            usual = min(median(others), 1.0) if others else 1.0
            lost = own is not None and own < limit * usual and usual > _ALL_LOST
            if counts_as_bad if shown[name].clarity is None else lost:
                verdicts[name] = _Fault.LENS
        for name, now in shown.items():
            self._judge(self._cameras[name], verdicts[name], now, time_s)
        return {name: fault.reason(name) for name in shown if (fault := self._cameras[name].fault) is not None}

    def _is_noise(self, now: Shown, camera: _Camera) -> bool:
        parameters = self._parameters
        if now.white > parameters.max_white or camera.noisiest is None:
            return now.white > parameters.max_white
        white_rise, rough_rise = (now.white, now.rough) - camera.noisiest
        return bool(white_rise > parameters.max_white_rise or rough_rise > parameters.max_rough_rise)

    def _kept(self, now: Shown, camera: _Camera) -> float | None:
        """Contrast or sharpness over the camera's usual one, whichever is less; None: one of them is not known."""
        if now.clarity is None or camera.usual is None:
            return None
        contrast, sharpness = (now.clarity / np.maximum(camera.usual, 1e-6)).tolist()
        if camera.usual[0] < 2.0 * _FAINTEST:
            return None
        return float(min(contrast, sharpness) if now.clarity[0] > _FAINTEST else contrast)

    def _judge(self, camera: _Camera, verdict: _Fault | None, now: Shown, time_s: float) -> None:
        """Updates the camera's verdict, and its memory with an image that is used."""
        at_once, fault = (_Fault.NOISE, _Fault.DAMAGE), verdict
        if not (settled := verdict is camera.fault or verdict in at_once):
            camera.since_s, camera.images = min(camera.since_s, time_s), camera.images + 1
            settled = time_s - camera.since_s >= _LASTS_S and camera.images >= _LEAST_IMAGES
            if camera.fault in at_once:
                fault, settled = None, camera.images >= self._parameters.clean_images
        if settled:
            camera.fault, camera.since_s, camera.images = fault, math.inf, 0
        if camera.fault is _Fault.LENS:
            camera.noisiest = None  # after a bad lens the view may change at once
        elif camera.fault is None:
            shares = np.array([now.white, now.rough])
            if camera.noisiest is not None:
                shares = np.maximum(shares, camera.noisiest * math.exp((camera.used_s - time_s) / _FADES_S))
            camera.noisiest, camera.used_s = shares, time_s
            if verdict is None and now.clarity is not None:
                step_s = min(max(time_s - camera.time_s, 0.0), _FORGOTTEN_S)
                camera.remembered_s = min(camera.remembered_s + step_s, _REMEMBERED_S)
                usual = now.clarity if camera.usual is None else camera.usual
                camera.usual = usual + step_s / max(camera.remembered_s, 1e-3) * (now.clarity - usual)
        camera.time_s = time_s


def unexplained_share(before: UInt8Array, now: UInt8Array) -> float:
    """Share, 0 to 1, of a small grey image (h, w) that the one before does not explain, without what came into view."""
    height, width = now.shape
    if before.shape != now.shape or min(now.shape) < 2 * _PATCH_PX:
        return 0.0
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    dis.setFinestScale(0)
    dis.setPatchSize(_PATCH_PX)
    flow = dis.calc(now, before, np.zeros((height, width, 2), np.float32))
    u, v = _pixels(width, height) + flow.transpose(2, 0, 1)
    seen_before = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    planes = np.empty((height, width, 5), np.float32)
    planes[..., 0] = cv2.remap(before, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    planes[..., 1] = now
    planes[..., 2:4] = planes[..., :2] ** 2
    planes[..., 4] = planes[..., 0] * planes[..., 1]
    moved, new, moved2, new2, product = cv2.blur(planes, (_WINDOW_PX, _WINDOW_PX)).transpose(2, 0, 1)
    # A change of light is no damage: level and gain do not count.
    before2, now2 = moved2 - moved**2, new2 - new**2
    correlation = (product - moved * new) / np.sqrt(np.maximum(before2 * now2, 1.0))
    differs = (np.minimum(before2, now2) > _MIN_CONTRAST**2) & (correlation < _MIN_CORRELATION) & seen_before
    return float(np.count_nonzero(differs)) / max(float(np.count_nonzero(seen_before)), 1.0)


@lru_cache(maxsize=8)
def _pixels(width: int, height: int) -> Float32Array:
    """(2, height, width) columns and rows."""
    return np.indices((height, width), np.float32)[::-1]
