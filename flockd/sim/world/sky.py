"""Sun, skylight, haze, the sky's image, and the camera's tone curve."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from flockd.core.messages import FloatArray, UInt8Array
from flockd.sim.world import textures
from flockd.sim.world.textures import PackedArray

SKY_BITS = 9


def draw_sky(rng: Generator) -> tuple[FloatArray, float, PackedArray]:
    """Sun, skylight, haze and the sky's map. Scaled so that level ground receives about 1."""
    elevation, azimuth = math.radians(rng.uniform(25, 70)), rng.uniform(0, 2 * math.pi)
    level = math.cos(elevation)
    sun = np.array([level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation)])
    overcast = float(rng.choice([0.0, 0.0, rng.uniform(0, 0.6), rng.uniform(0.7, 1.0)]))
    warm = (math.radians(70) - elevation) / math.radians(45) * rng.uniform(0.3, 1.0)
    sun_colour = np.array([1.0, 1.0 - 0.14 * warm, 1.0 - 0.38 * warm]) * (1.0 - 0.92 * overcast)
    blue = np.array([0.62, 0.8, 1.1]) * rng.uniform(0.93, 1.07, 3)
    skylight = (blue * (1 - overcast) + np.array([0.95, 1.0, 1.05]) * overcast) * rng.uniform(0.16, 0.36)
    skylight = skylight * (1.0 + 1.5 * overcast)
    irradiance = float((sun_colour * math.sin(elevation) + skylight).mean())
    exposure = 2.0 ** rng.uniform(-0.55, 0.35) / irradiance
    sun_colour, skylight = sun_colour * exposure, skylight * exposure
    bounce = rng.uniform(0.15, 0.3) * (sun_colour * math.sin(elevation) + skylight) * rng.uniform(0.8, 1.0, 3)
    zenith = np.array([0.1, 0.24, 0.62]) * (1 - overcast) + 0.42 * overcast
    zenith = zenith * rng.uniform(0.75, 1.2) * rng.uniform(0.93, 1.07, 3)
    horizon = np.array([0.55, 0.68, 0.85]) * (1 - overcast) + 0.62 * overcast
    horizon = horizon * rng.uniform(0.7, 1.15) * rng.uniform(0.95, 1.05, 3)
    fog = math.exp(rng.uniform(math.log(0.0006), math.log(0.007)))

    size = 1 << SKY_BITS
    t = (np.arange(size) + 0.5) / size - 0.5
    a, b = t[None, :], t[:, None]
    north, east = a + b, a - b
    up = np.maximum(0.0, 1.0 - np.abs(north) - np.abs(east))
    norm = np.sqrt(north**2 + east**2 + up**2)
    north, east, up = north / norm, east / norm, up / norm
    height = np.clip(up, 0, 1)[..., None] ** rng.uniform(0.4, 0.7)
    sky = horizon * (1 - height) + zenith * height
    toward = np.clip(north * sun[0] + east * sun[1] - up * sun[2], 0, 1)[..., None]
    sky = sky + sun_colour * (0.25 * toward**8 + 0.8 * toward**120) * (1 - overcast)
    clouds = textures.fractal_noise(rng, size, slope=rng.uniform(1.3, 1.8), coarsest=0.3)
    drop = rng.uniform(2.5, 6.0) * (up + 0.12)
    row, column = ((way / drop * size).astype(np.int64) % size for way in (east, north))
    density = clouds[row, column]
    cover = rng.uniform(-1.3, 0.6) + 1.5 * overcast
    amount = np.clip((density + cover) * rng.uniform(0.5, 1.5), 0, 1)[..., None] * np.clip(up * 5, 0, 1)[..., None]
    white = (0.95 * (1 - overcast) + 0.8 * overcast) * (1.15 - 0.25 * np.clip(density, 0, 2)[..., None])
    sky = sky * (1 - amount) + white * amount
    light = np.stack([sun, sun_colour, skylight, bounce, horizon])
    return light, fog, textures.pack_pyramid((sky / 4.0).astype(np.float32))


def tone_curve(rng: Generator) -> UInt8Array:
    """Soft shoulder, then the sRGB encoding."""
    linear = (np.arange(2049) / 1024.0) ** 2
    strength = rng.uniform(0.9, 1.4)
    y = (1 - np.exp(-strength * linear)) / (1 - math.exp(-strength * 3.0))
    y = np.minimum(y, 1.0) ** rng.uniform(1.0, 1.2)
    srgb = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * srgb), dtype=np.uint8)
