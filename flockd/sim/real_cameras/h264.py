"""H.264 of a camera's images, by the system's library openh264 (Cisco, BSD-2-Clause), as no wheel of a licence
that flockd may use brings an encoder. Its interface is that of its `codec_api.h`, versions 2.0 to 2.6."""

from __future__ import annotations

import ctypes
import ctypes.util
import weakref
from functools import cache
from typing import Any

import cv2
import numpy as np

from flockd.core.errors import UnavailableError
from flockd.core.messages import UInt8Array

RATE_HZ = 30.0
"""Images a second that a bit rate is of."""
_I420, _BY_BIT_RATE, _NO_OUTPUT = 23, 1, 0
_ENCODER_SKIPS, _ENCODER_LOGS, _DECODER_LOGS = 9, 25, 9
"""Options: whether images are left out to keep the bit rate, and how much is written to standard error."""
_INITIALIZE, _UNINITIALIZE, _ENCODE, _SET_ENCODER = 0, 3, 4, 7
_UNINITIALIZE_DECODER, _DECODE, _SET_DECODER = 1, 3, 8
"""Places in the tables of functions."""
_LAYERS = 128


class _EncoderParameters(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("usage", "width", "height", "bits_a_second", "control")),
        ("images_a_second", ctypes.c_float),
    )


class _Picture(ctypes.Structure):
    _fields_ = (
        ("format", ctypes.c_int),
        ("stride", ctypes.c_int * 4),
        ("planes", ctypes.c_void_p * 4),
        ("width", ctypes.c_int),
        ("height", ctypes.c_int),
        ("time_ms", ctypes.c_longlong),
        ("psnr", ctypes.c_bool * 3),  # since 2.6; others do not look there
    )


_LAYER = (
    ("ids", ctypes.c_ubyte * 3),
    ("kind", ctypes.c_int),
    ("layer", ctypes.c_ubyte),
    ("sequence", ctypes.c_int),
    ("units", ctypes.c_int),
    ("lengths", ctypes.POINTER(ctypes.c_int)),
    ("data", ctypes.c_void_p),
)


class _DecoderParameters(ctypes.Structure):
    _fields_ = (
        ("file", ctypes.c_char_p),
        ("load", ctypes.c_uint),
        ("layer", ctypes.c_ubyte),
        ("concealment", ctypes.c_int),
        ("parse_only", ctypes.c_bool),
        ("size", ctypes.c_uint),
        ("kind", ctypes.c_int),
    )


class _Decoded(ctypes.Structure):
    _fields_ = (
        ("status", ctypes.c_int),
        ("times", ctypes.c_ulonglong * 2),
        ("width", ctypes.c_int),
        ("height", ctypes.c_int),
        ("format", ctypes.c_int),
        ("stride", ctypes.c_int * 2),
        ("planes", ctypes.c_void_p * 3),
    )


class _Version(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_uint) for name in ("major", "minor", "revision", "reserved"))


@cache
def _library() -> tuple[ctypes.CDLL, type[ctypes.Structure]]:
    """The library, and how it describes what it encoded."""
    name = ctypes.util.find_library("openh264")
    needs = "`cameras.compression.h264_mbit_s` needs the library openh264, version 2.0 to 2.6"
    if name is None:
        raise UnavailableError(
            f"{needs}, which is not on this machine: on Debian and Ubuntu, `apt install libopenh264-7`."
        )
    library, version = ctypes.CDLL(name), _Version()
    library.WelsGetCodecVersionEx(ctypes.byref(version))
    if version.major != 2 or version.minor > 6:
        raise UnavailableError(f"{needs}; this machine's is {version.major}.{version.minor}.")
    psnr = (("psnr", ctypes.c_float * 3),) if version.minor == 6 else ()

    class Layer(ctypes.Structure):
        _fields_ = (*_LAYER, *psnr)

    class Encoded(ctypes.Structure):
        _fields_ = (
            ("count", ctypes.c_int),
            ("layers", Layer * _LAYERS),
            ("kind", ctypes.c_int),
            ("size", ctypes.c_int),
            ("time_ms", ctypes.c_longlong),
        )

    return library, Encoded


class _Codec:
    """An encoder or decoder: a pointer to a table of functions, which take it first."""

    def __init__(self, kind: str) -> None:
        self._library, self._kind, self._handle = _library()[0], kind, ctypes.c_void_p()
        made = getattr(self._library, f"WelsCreate{kind}")(ctypes.byref(self._handle))
        if made != 0 or not self._handle:
            raise UnavailableError(f"openh264 makes no {kind} ({made})")
        self._table = ctypes.cast(self._handle, ctypes.POINTER(ctypes.POINTER(ctypes.c_void_p))).contents

    def call(self, place: int, *arguments: Any) -> None:
        """Raises UnavailableError where the library says that it failed."""
        of_any_arguments = ctypes.CFUNCTYPE(ctypes.c_int)
        code = of_any_arguments(self._table[place])(self._handle, *arguments)
        if code != 0:
            raise UnavailableError(f"openh264: function {place} of the {self._kind} failed with {code}")

    def close(self, uninitialize: int) -> None:
        """Frees it."""
        self.call(uninitialize)
        getattr(self._library, f"WelsDestroy{self._kind}")(self._handle)


def _close(encoder: _Codec, decoder: _Codec) -> None:
    encoder.close(_UNINITIALIZE)
    decoder.close(_UNINITIALIZE_DECODER)


class H264Stream:
    """One camera's stream: each image is predicted from the one before it, and the first stands alone."""

    def __init__(self, size: tuple[int, int], mbit_s: float) -> None:
        """`size`: width and height. Raises UnavailableError where they are odd, the library is missing, or refuses."""
        if any(side % 2 for side in size):
            raise UnavailableError(
                f"`cameras.compression.h264_mbit_s`: images of {size[0]} x {size[1]} have odd sides."
            )
        self._size, self._number = size, 0
        parameters = _EncoderParameters(0, *size, round(1e6 * mbit_s), _BY_BIT_RATE, RATE_HZ)
        self._encoder, self._decoder = _Codec("SVCEncoder"), _Codec("Decoder")
        quiet, never = ctypes.c_int(0), ctypes.c_bool(False)
        self._encoder.call(_SET_ENCODER, _ENCODER_LOGS, ctypes.byref(quiet))
        self._encoder.call(_INITIALIZE, ctypes.byref(parameters))
        self._encoder.call(_SET_ENCODER, _ENCODER_SKIPS, ctypes.byref(never))
        self._decoder.call(_SET_DECODER, _DECODER_LOGS, ctypes.byref(quiet))
        self._decoder.call(_INITIALIZE, ctypes.byref(_DecoderParameters(layer=255, size=8)))
        weakref.finalize(self, _close, self._encoder, self._decoder)

    def passed(self, image: UInt8Array) -> tuple[UInt8Array, bytes]:
        """The RGB image (h, w, 3) as it comes out of the stream, and what the stream got of it."""
        width, height = self._size
        planes = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420))
        start, luma = planes.ctypes.data, width * height
        picture = _Picture(_I420, width=width, height=height, time_ms=round(1e3 * self._number / RATE_HZ))
        picture.stride[:3] = width, width // 2, width // 2
        picture.planes[:3] = start, start + luma, start + luma + luma // 4
        encoded = _library()[1]()
        self._encoder.call(_ENCODE, ctypes.byref(picture), ctypes.byref(encoded))
        self._number += 1
        packed = b"".join(
            ctypes.string_at(one.data, sum(one.lengths[: one.units])) for one in encoded.layers[: encoded.count]
        )
        decoded, out = _Decoded(), (ctypes.c_void_p * 3)()
        self._decoder.call(_DECODE, packed, len(packed), out, ctypes.byref(decoded))
        if decoded.status == _NO_OUTPUT:
            raise UnavailableError("openh264 decodes nothing of what it encoded")
        shown = np.empty_like(planes)
        parts = ((height, width, 0), (height // 2, width // 2, 1), (height // 2, width // 2, 1))
        at, flat = 0, shown.reshape(-1)
        for plane, (rows, columns, stride) in zip(out, parts, strict=True):
            pitch = decoded.stride[stride]
            data = np.frombuffer(ctypes.string_at(plane, pitch * rows), np.uint8).reshape(rows, pitch)
            flat[at : at + rows * columns] = data[:, :columns].ravel()
            at += rows * columns
        return np.asarray(cv2.cvtColor(shown, cv2.COLOR_YUV2RGB_I420), np.uint8), packed
