"""Real cameras: from a view that was drawn to the image that a drone gets."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from flockd.core.messages import FloatArray, UInt8Array
from flockd.flight.geometry import Camera
from flockd.sim.cameras.compression import jpeg
from flockd.sim.cameras.glass import Glass
from flockd.sim.cameras.light import grey_levels, linear_light
from flockd.sim.cameras.sensor import Automatic, NoiseTile, noisy
from flockd.sim.cameras.shake import Shaking
from flockd.sim.cameras.shutter import CameraMotion, LensField, exposed
from flockd.sim.cameras.timing import CameraClock
from flockd.sim.renderer.renderer import View
from flockd.sim.scenario.imperfect_cameras import CamerasConfig


class RealCamera:
    """One camera of one drone, with its own dirt, phases and noise. Its images depend on no other camera's."""

    def __init__(self, config: CamerasConfig, lens: LensField, tile: NoiseTile, seed: tuple[int, ...]) -> None:
        """``seed`` is of this camera alone."""
        height, width = lens.u.shape
        self._config, self._lens, self._tile = config, lens, tile
        self.clock = CameraClock(config.timing, np.random.default_rng([*seed, 0]))
        self.shaking = Shaking(config.shake, np.random.default_rng([*seed, 1]))
        self._glass = Glass.of(config.lens, (width, height), np.random.default_rng([*seed, 2]))
        self._automatic = Automatic(config.automatic)
        self._rng = np.random.default_rng([*seed, 3])

    def image(self, view: View, motion: CameraMotion, time_s: float, sun: FloatArray) -> UInt8Array:
        """What the sensor sees, in the order of light: shutter, glass, automatics, noise by gain.

        ``sun`` (3,) is the unit vector towards it in the camera's axes. What is not configured changes no bit.
        """
        config, lens = self._config, self._lens
        light = linear_light(view.rgb)
        light = exposed(light, view, lens, motion, config.shutter)
        if config.lens.flare or config.lens.dirt or config.lens.drops:
            light = self._glass.passed(light, lens, np.isinf(view.depth), sun)
        brightened = 1.0
        if config.automatic.exposure or config.automatic.white_balance:
            gains = self._automatic.gains(light, lens.imaged, time_s)
            light, brightened = light * gains.astype(np.float32), float(gains[1])
        height, width = (config.reduce * side for side in lens.u.shape)
        if config.reduce > 1:
            light = np.asarray(cv2.resize(light, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)
        if config.noise.gain > 0:
            light = noisy(light, self._tile.crop(height, width, self._rng), config.noise, brightened)
        return grey_levels(light)

    def compressed(self, image: UInt8Array) -> UInt8Array:
        """The image as the camera sends it."""
        quality, reduce = self._config.compression.jpeg_quality, self._config.reduce
        if quality is not None:
            return jpeg(image, quality, reduce)
        height, width = self._lens.u.shape
        return image if reduce == 1 else np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def real_cameras(
    config: CamerasConfig, cameras: Mapping[str, Camera], drones: int, seed: int
) -> dict[tuple[int, str], RealCamera]:
    """The same lenses on each of so many drones, by drone (from 0) and name."""
    tile = NoiseTile(seed)
    lenses = {name: LensField.of(camera) for name, camera in cameras.items()}
    return {
        (drone, name): RealCamera(config, lens, tile, (seed, 4, drone, number))
        for drone in range(drones)
        for number, (name, lens) in enumerate(lenses.items())
    }
