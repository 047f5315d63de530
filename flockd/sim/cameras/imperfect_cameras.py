"""Faults of a simulated drone's cameras, each by its physical size; 0: ideal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from flockd.core.choices import CameraPreset
from flockd.core.config.base import NonNegative, Positive, Section, Share

MAX_LATE_S = 0.3
"""The largest delay of an image or an attitude: older poses are not kept."""
_Late = Annotated[float, Field(ge=0, le=MAX_LATE_S)]


class ShutterConfig(Section):
    """Exposure of an image's rows."""

    exposure_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Exposure time of each row; motion in this time blurs the image."""
    readout_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Time from the exposure of the first row to that of the last (rolling shutter); 0: all at once (global shutter).
    An image's time is that of its middle row."""
    readout_from: Literal["top", "right", "left"] = "top"
    """Side of the sensor's first row in the upright image: for a camera on its side right (`turn_deg` 90) or left
    (270)."""


class ShakeConfig(Section):
    """Shake of each camera by the propellers: angles about its three axes, with phases from the seed."""

    rms_deg: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Root mean square of the angle about each axis."""
    frequency_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    """Revolutions of the propellers per second. Four tones within 10 % of it have 80 % of the power; the rest is at
    twice the frequency, at which the two blades pass."""


class SensorNoiseConfig(Section):
    """Noise of the image sensor by its gain (EMVA 1288): shot noise and read noise."""

    gain: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Amplification relative to that at which a full well is white; 0: uniform noise, `sensors.image_noise`."""
    full_well_e: Positive = 4300.0
    """Electrons that a pixel holds."""
    read_noise_e: NonNegative = 1.7
    """Standard deviation, in electrons."""


class LensFaultsConfig(Section):
    """Faults of the lens."""

    flare: Share = 0.0
    """Share of scattered light (veiling glare index, ISO 9358), with the sun's if it is in view: half of the sun's
    light evenly over the image, half around the sun."""


class CompressionConfig(Section):
    """Compression of each image, as by a camera of pixel format `mjpeg`."""

    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    """null: none."""


class CameraTimingConfig(Section):
    """Times of exposure, delays and losses of images."""

    apart_s: _Late = 0.0
    """Free-running cameras: each exposes up to this time before the set's time, with correct time stamps."""
    delay_s: _Late = 0.0
    """Time by which images are older than their time stamps."""
    jitter_s: _Late = 0.0
    """Largest additional age of each image, at random."""
    dropped: Share = 0.0
    """Share of lost images."""


class RigErrorsConfig(Section):
    """Calibration errors of each camera of each drone, in random directions from the seed. For wrong time stamps use
    `timing.delay_s`."""

    mounting_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Angle by which its mounting is turned about a random axis."""
    mounting_m: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Distance by which its mounting is displaced."""
    focal: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """Share by which its focal lengths are longer or shorter."""


_PRESETS: Mapping[CameraPreset, Mapping[str, Mapping[str, Any]]] = {
    "ideal": {},
    "realistic": {
        # As `config/quadrotor.yaml` sets it; a sensor of at most 60 images a second: rows take 1 / (60 rows), the rule
        # of https://docs.luxonis.com/hardware/platform/sensors/shutter-type.
        "shutter": {"exposure_s": 0.005, "readout_s": 0.0167},
        # 0.3 rad/s at 100 Hz, an assumption: docs/cameras.md says how to measure one's own. Propellers turn at
        # 40-300 Hz: https://diydrones.com/forum/topics/vibration-analysis-1.
        "shake": {"rms_deg": 0.03, "frequency_hz": 100.0},
        # OV5647, 1.4 um: 4.3 ke, 36 dB, 68 dB, so 4300 / 10^(68 / 20) = 1.7 e (user guide of the OptArc AF51, page 21).
        # 12 dB of gain: a cloudy day at 5 ms.
        "noise": {"gain": 4.0, "full_well_e": 4300.0, "read_noise_e": 1.7},
        # Simple lenses measure 1 to 3 % (https://www.imatest.com/docs/veilingglare/).
        "lens": {"flare": 0.02},
        "compression": {"jpeg_quality": 80},
        # Free running at 30 Hz; what a calibration of the delay leaves; USB's share.
        "timing": {"apart_s": 0.0167, "delay_s": 0.005, "jitter_s": 0.003, "dropped": 0.01},
    },
}  # fmt: skip


class CamerasConfig(Section):
    """Cameras as a real drone has them. The lens is that of the drone's own rig.

    The preset gives all other values: `preset: realistic` with `shutter: {readout_s: 0}` is a realistic camera with a
    global shutter.
    """

    preset: CameraPreset = "ideal"
    """`ideal`: no fault. `realistic`: a cheap USB camera with a rolling shutter on a small drone by day, from data
    sheets (sources in `flockd/sim/cameras/imperfect_cameras.py`)."""
    shutter: ShutterConfig = ShutterConfig()
    shake: ShakeConfig = ShakeConfig()
    noise: SensorNoiseConfig = SensorNoiseConfig()
    lens: LensFaultsConfig = LensFaultsConfig()
    compression: CompressionConfig = CompressionConfig()
    reduce: Literal[1, 2, 4] = 1
    """As in a drone's `source.cameras`: the sensor has more pixels in each direction by this factor, each with `noise`,
    and the compressed image is reduced."""
    timing: CameraTimingConfig = CameraTimingConfig()
    rig: RigErrorsConfig = RigErrorsConfig()

    @model_validator(mode="before")
    @classmethod
    def _begin_with_the_preset(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        filled: dict[str, Any] = dict(values)
        known = {str(name): sections for name, sections in _PRESETS.items()}
        for section, defaults in known.get(str(values.get("preset")), {}).items():
            given = filled.get(section, {})
            filled[section] = {**defaults, **given} if isinstance(given, Mapping) else given
        return filled

    @model_serializer(mode="wrap")
    def _say_what_differs_from_the_preset(self, dumped: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """So that another preset may be written over it, as by a campaign, without this one's values staying."""
        usual = type(self)(preset=self.preset)
        values: dict[str, Any] = dumped(self)
        for name in set(values) - {"preset"}:
            mine, its = getattr(self, name), getattr(usual, name)
            if mine == its:
                del values[name]
            elif isinstance(its, Section):
                values[name] = {key: of for key, of in values[name].items() if getattr(mine, key) != getattr(its, key)}
        return values
