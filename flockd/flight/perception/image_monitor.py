"""Whether a camera's image is to be used: it is no noise, follows from the one before, and shows the ground clearly.

Each image is reduced once: to the strength of its details of 2 to 16 pixels in blocks, by the diagonal details of an
orthonormal Haar transform, and to a small grey image. What these are is judged by what the camera showed before, and by
what the other cameras of the rig show at the same moment.

Noise: white noise is as strong at each scale, while scenes lose their contrast from scale to scale. The power spectrum
of photographs falls with the square of the frequency (Field 1987, Ruderman and Bialek 1994), so the details are about
half as strong at the finest scale as at the next. The finest alone (Donoho and Johnstone 1994, Immerkaer 1996) would
not do: grass and leaves have as much of them as noise. Noise that was filtered, as by a camera's own electronics, has
the spectrum of gravel. It is told by how it comes: at once and everywhere, while what a drone sees changes slowly.

Continuity: a scene is explained by its last image, moved along the optical flow, whatever its texture is. Noise and
damage in blocks come anew with each image. How much is left unexplained also depends on how the drone moves, but it
moves all of its cameras: one is compared with the others, while the drone turns slowly. A single camera is not judged.

Lens: cover, dirt, fog and sun take contrast or sharpness from the image, and stay. Sky has none of either, so only
blocks that look at the ground count. Ground without contrast, dusk and mist take it from all cameras. Local contrast
and the share of it at a finer scale are usual measures of quality (S. Pertuz et al., "Analysis of focus measure
operators for shape-from-focus", Pattern Recognition 46(5), 2013). Contrast is a share of the brightness (E. Peli,
"Contrast in complex images", JOSA A 7(10), 1990): asphalt beside gravel is darker as well as smoother, while a veil of
fog or stray light is bright.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import Float32Array, FloatArray, Reason, ReasonKind, UInt8Array
from flockd.flight.geometry import RigCamera, grid_pixels

_BLOCK_PX = 32
_SIGMA_PER_MEAN = math.sqrt(math.pi / 2)
"""Standard deviation over the mean magnitude, for normal numbers."""
_FORGOTTEN_S = 2.0
"""After so long without an image, a camera may see something else entirely."""
_FADES_S = 30.0
"""Within which the noisiest that a camera showed fades: gravel that a wall covered is no noise when it comes back."""

_LONGER_SIDE_PX = 96
"""Of the small images that are compared: noise of single pixels averages out, and DIS takes a millisecond."""
_PATCH_PX = 8
_WINDOW_PX = 15
"""Over which they are compared, so that a damaged block has contrast in any window that it is in."""
_MIN_CONTRAST, _MIN_CORRELATION = 10.0, 0.7
"""Where both have at least so much contrast, standard deviation in grey levels, and less correlation, they differ."""
_MAX_TURN = math.radians(10.0)
"""Of the drone between two images: beyond it the flow is lost, in one camera before the others."""

_BELOW_RAD = math.radians(10.0)
"""A block that looks down at least so steeply shows ground, over hills too."""
_LEAST_BLOCKS, _QUANTILE = 12, 0.75
"""With fewer that show ground nothing is said. A plain wall takes the contrast from some blocks, a lens from all."""
_DARK = 32.0
"""Grey levels that are added to the brightness: a camera's noise under a dark cover is no contrast."""
_FAINTEST = 0.004
"""Contrast of a camera's noise; ground that has less says nothing of sharpness."""
_REMEMBERED_S, _KNOWN_S = 300.0, 10.0
"""What a camera usually shows of the ground is the mean over so long. Before it is known for so long, only images that
have lost more say that a lens is bad: the limit grows from 0."""
_LASTS_S, _LEAST_IMAGES = 2.0, 3
"""So long, and in so many images, a lens is bad, or good again, before it counts: a gust turns a camera briefly."""
_ALL_LOST = 0.1
"""Where the other cameras keep no more, as after a landing in grass, no lens is judged."""
_GOOD_AGAIN = 1.25
"""Factor on the limit for a lens that was bad."""


class Shown(NamedTuple):
    """What one image is reduced to."""

    white: float
    """The share of its blocks, 0 to 1, where fine details are strong, and not much weaker than those twice the size."""
    rough: float
    """The share where details of one of the three scales are very strong."""
    clarity: FloatArray | None
    """(2,) contrast of the ground, a share of its brightness, and sharpness, a share of its contrast; None: too little
    ground is in view."""
    small: UInt8Array
    """Grey, `_LONGER_SIDE_PX` along the longer side."""


def shown_in(image: UInt8Array, parameters: NoiseParameters, downwards: FloatArray) -> Shown:
    """Of an RGB image (h, w, 3).

    Args:
        image: of any size; of one smaller than a block nothing is said but its small image.
        parameters: of the configuration.
        downwards: (rows, columns) of its blocks: the sine of the angle below the horizon; NaN where nothing is imaged.
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
        shares = np.stack([coarsest, middle]) / brightness
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
    """What is remembered of one camera."""

    rays: FloatArray
    """(rows, columns, 3) unit vectors in body axes through its blocks' middles; NaN where the lens images nothing."""
    time_s: float = -math.inf
    """Of its last image."""
    last: UInt8Array | None = None
    """Small; None after noise."""
    used_s: float = -math.inf
    """Of the last that was used."""
    noisiest: FloatArray | None = None
    """(2,) shares of white and of rough blocks in images that were used, fading."""
    usual: FloatArray | None = None
    """(2,) mean clarity of images that were used."""
    remembered_s: float = 0.0
    """For so long."""
    fault: _Fault | None = None
    since_s: float = math.inf
    """Since when it shows otherwise than it counts."""
    images: int = 0
    """As many since then."""


class ImageMonitor:
    """Tells which images of a rig's cameras are not to be used."""

    def __init__(self, cameras: Mapping[str, RigCamera], parameters: NoiseParameters) -> None:
        self._parameters = parameters
        self._cameras = {name: _Camera(_block_rays(camera)) for name, camera in cameras.items()}
        self._R_ned_body: FloatArray = np.eye(3)

    def faults(self, images: Mapping[str, UInt8Array], time_s: float, R_ned_body: FloatArray) -> dict[str, Reason]:
        """The cameras whose newest images are not to be used, and why; to be called once for each moment.

        After noise or damage, so are those that follow until some in a row were clean.

        Args:
            images: RGB images (h, w, 3) of one moment, by camera, of the rig's sizes.
            time_s: their time.
            R_ned_body: (3, 3) the drone's attitude then.
        """
        turns = float(np.vdot(self._R_ned_body, R_ned_body)) < 1.0 + 2.0 * math.cos(_MAX_TURN)  # by the trace
        self._R_ned_body = R_ned_body
        shown, verdicts, unexplained = {}, dict[str, _Fault | None](), {}
        for name, image in images.items():
            camera = self._cameras[name]
            now = shown[name] = shown_in(image, self._parameters, camera.rays @ R_ned_body[2])
            if not 0.0 <= time_s - camera.time_s <= _FORGOTTEN_S:
                camera.last, camera.noisiest, camera.since_s, camera.images = None, None, math.inf, 0
            elif time_s - camera.used_s > _FADES_S:
                camera.noisiest = None
            verdicts[name] = _Fault.NOISE if self._is_noise(now, camera) else None
            if camera.last is not None and not (verdicts[name] or turns):
                unexplained[name] = unexplained_share(camera.last, now.small)
            camera.last = None if verdicts[name] else now.small
        for name, share in unexplained.items():
            others = [other for camera, other in unexplained.items() if camera != name]
            if others and share - _median(others) > self._parameters.max_unexplained:
                verdicts[name] = _Fault.DAMAGE
        kept = {name: self._kept(now, self._cameras[name]) for name, now in shown.items() if not verdicts[name]}
        for name, own in kept.items():
            others = [other for camera, other in kept.items() if camera != name and other is not None]
            counts_as_bad = self._cameras[name].fault is _Fault.LENS
            limit = self._parameters.min_clarity * (_GOOD_AGAIN if counts_as_bad else 1.0)
            limit *= min(self._cameras[name].remembered_s / _KNOWN_S, 1.0)
            usual = min(_median(others), 1.0) if others else 1.0
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
        """Contrast or sharpness, whichever has lost more, over the camera's own; None: one of them is not known."""
        if now.clarity is None or camera.usual is None:
            return None
        contrast, sharpness = (now.clarity / np.maximum(camera.usual, 1e-6)).tolist()
        if camera.usual[0] < 2.0 * _FAINTEST:
            return None
        return float(min(contrast, sharpness) if now.clarity[0] > _FAINTEST else contrast)

    def _judge(self, camera: _Camera, verdict: _Fault | None, now: Shown, time_s: float) -> None:
        """What the camera counts as from now on; an image that is used is remembered."""
        if verdict in (_Fault.NOISE, _Fault.DAMAGE):
            camera.fault, camera.since_s, camera.images = verdict, math.inf, 0
        elif verdict is camera.fault:
            camera.since_s, camera.images = math.inf, 0
        else:
            camera.since_s, camera.images = min(camera.since_s, time_s), camera.images + 1
            if camera.fault in (_Fault.NOISE, _Fault.DAMAGE):
                if camera.images >= self._parameters.clean_images:
                    camera.fault, camera.since_s, camera.images = None, math.inf, 0
            elif time_s - camera.since_s >= _LASTS_S and camera.images >= _LEAST_IMAGES:
                camera.fault, camera.since_s, camera.images = verdict, math.inf, 0
        if camera.fault is _Fault.LENS:
            camera.noisiest = None  # once it is clear, any view may come all at once
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
    """The share, 0 to 1, of a small grey image (h, w) that the one before does not explain; what came into view is not
    counted."""
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
    # Light that changes is no damage: neither level nor gain counts.
    before2, now2 = moved2 - moved**2, new2 - new**2
    correlation = (product - moved * new) / np.sqrt(np.maximum(before2 * now2, 1.0))
    differs = (np.minimum(before2, now2) > _MIN_CONTRAST**2) & (correlation < _MIN_CORRELATION) & seen_before
    return float(np.count_nonzero(differs)) / max(float(np.count_nonzero(seen_before)), 1.0)


@lru_cache(maxsize=8)
def _pixels(width: int, height: int) -> Float32Array:
    """(2, height, width) columns and rows."""
    return np.indices((height, width), np.float32)[::-1]


def _median(values: list[float]) -> float:
    ordered, middle = sorted(values), len(values) // 2
    return (ordered[middle] + ordered[~middle]) / 2.0


def _block_rays(camera: RigCamera) -> FloatArray:
    columns, rows = (length // _BLOCK_PX for length in camera.camera.size)
    middles = grid_pixels((columns, rows), 1) * _BLOCK_PX
    rays = camera.camera.rays(middles) @ camera.T_body_camera.rotation.T
    return rays.reshape(rows, columns, 3)
