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
    """When the rows of an image are exposed."""

    exposure_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Exposure of each row: what moves is smeared along its way in that time."""
    readout_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """From the exposure of the first row to that of the last, one row after the other (rolling shutter); 0: all at
    once (global shutter). An image shows the middle row at its time."""
    readout_from: Literal["top", "right", "left"] = "top"
    """Where the sensor's first row is in the upright image: of a camera on its side (`turn_deg` 90, 270) at the right,
    at the left."""


class ShakeConfig(Section):
    """How propellers shake each camera on its mounting: angles about its three axes, of seeded phases."""

    rms_deg: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Root mean square of the angle about each axis."""
    frequency_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    """Revolutions of the propellers each second: four tones within 10 % of it hold 80 % of the power, the passing of
    two blades, at twice the frequency, the rest."""


class SensorNoiseConfig(Section):
    """Noise of the image sensor by its gain (EMVA 1288): shot noise of electrons, and noise of reading them out."""

    gain: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Amplification over that at which a full well is white; 0: the same noise everywhere, `sensors.image_noise`."""
    full_well_e: Positive = 4300.0
    """Electrons that a pixel holds."""
    read_noise_e: NonNegative = 1.7
    """Standard deviation, in electrons."""


class LensFaultsConfig(Section):
    """What is in the glass."""

    flare: Share = 0.0
    """Share of the light that is scattered over the image, the sun's included where the lens sees it (veiling glare
    index, ISO 9358): half of the sun's evenly, half around it."""


class CompressionConfig(Section):
    """Compression of each image by itself, as a camera of pixel format `mjpeg` sends it."""

    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    """null: none."""


class CameraTimingConfig(Section):
    """When cameras expose, and what becomes of the images."""

    apart_s: _Late = 0.0
    """Cameras run freely: each exposes up to this much before the set's time, and its time stamps say so."""
    delay_s: _Late = 0.0
    """Images are older by this than their time stamps say."""
    jitter_s: _Late = 0.0
    """Each image is older by up to this much more, at random."""
    dropped: Share = 0.0
    """Share of the images that never come."""


class RigErrorsConfig(Section):
    """Errors of each camera of each drone, in a direction of its own, drawn from the seed; pilots do not know of them.
    Wrong time stamps: `timing.delay_s`."""

    mounting_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Its mounting is turned by this angle about some axis."""
    mounting_m: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Its mounting is displaced by this distance."""
    focal: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """Its focal lengths are longer or shorter by this share."""


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

    A preset gives the values that are not written here: `preset: realistic` with `shutter: {readout_s: 0}` is a
    realistic camera with a global shutter.
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
    """As in a drone's `source.cameras`: the sensor has this many times the pixels either way, each as noisy as `noise`
    says, and the compressed image is reduced."""
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
