"""The separate process of one camera: runs a GStreamer pipeline, or subscribes to topics of ROS 2.

camera_child.py gstreamer CAPS        # reads the pipeline from standard input: its length, then UTF-8
camera_child.py ros TOPIC CAMERA_INFO_TOPIC system|simulator

It imports nothing of flockd, calls GStreamer through its C interface, and needs rclpy for topics. It ends when its
standard input is closed. It writes messages to standard output, each a header and its data:

- `caps`: the format of a pipeline's next images, as GStreamer's text.
- `imag`: one image, its time in nanoseconds of CLOCK_MONOTONIC (-1: no time), and whether it is damaged. The data of an
  Image of ROS begin with an `IMAGE_HEAD`. `jpeg`: likewise a CompressedImage.
- `info`: the `INFO_BODY` of a CameraInfo.
- `fail`: why no more images will come; a text. `end`: the pipeline has ended by itself.

It waits for a topic's publishers, and subscribes reliably if all of them are reliable, else with best effort.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from typing import Any, ClassVar

HEADER = struct.Struct("<4sIqI4x")
"""Kind, flags, time in ns, length of the data."""
CAPS, IMAGE, COMPRESSED, INFO, ERROR, END = b"caps", b"imag", b"jpeg", b"info", b"fail", b"end\0"
LENGTH = struct.Struct("<I")
DAMAGED = 1
"""A flag of an image."""
NO_TIME = -1
NOT_INSTALLED, NO_ROS = "GStreamer is not installed", "there is no rclpy"
IMAGES = {"sensor_msgs/msg/Image": (IMAGE, "Image"), "sensor_msgs/msg/CompressedImage": (COMPRESSED, "CompressedImage")}
IMAGE_HEAD = struct.Struct("<64sIII")
"""Encoding or format; width, height and bytes per line of an Image."""
INFO_BODY = struct.Struct("<II9d?")
"""See `numbers_of`."""

_END_S = 1.0
"""Time for a pipeline to close its camera."""
_SINK = b"flockd_sink"
_LOOK_NS = 50_000_000
_PREROLL_NS = 3_000_000_000
"""A pipeline that has not reported by then whether it is live reads a file."""
_PAUSED, _PLAYING, _NULL = 3, 4, 1  # GstState
_FAILED, _LIVE = 0, 3  # GST_STATE_CHANGE_FAILURE, _NO_PREROLL
_TIME = 3  # GST_FORMAT_TIME
_NONE = 2**64 - 1  # GST_CLOCK_TIME_NONE
_EOS, _ERROR = 1, 2  # GstMessageType
_CORRUPTED = 1 << 8  # GST_BUFFER_FLAG_CORRUPTED
_READ = 1  # GST_MAP_READ
_TOPIC_LOOK_S = 0.1
_CLOCK_S = 0.5
"""Time for which readings of a simulator's clock are kept: some arrive late, so the one with the least delay counts."""


class Buffer(ctypes.Structure):
    """The public head of GstBuffer of GStreamer 1.x, on 64-bit machines; GstMiniObject is its first 64 bytes."""

    _fields_: ClassVar = [("object", ctypes.c_uint8 * 64), ("pool", c_void_p), ("pts", c_uint64), ("dts", c_uint64)]


class _Map(ctypes.Structure):
    """GstMapInfo"""

    _fields_: ClassVar = [
        ("memory", c_void_p),
        ("flags", c_int),
        ("data", c_void_p),
        ("size", c_size_t),
        ("rest", c_void_p * 9),
    ]


class _Error(ctypes.Structure):
    """GError"""

    _fields_: ClassVar = [("domain", c_uint32), ("code", c_int), ("message", c_char_p)]


class _NoImagesError(Exception):
    """No images can be had; the text says why."""


def main() -> None:
    """Runs until the images end or the parent process closes a pipe."""
    output = os.dup(1)
    os.dup2(2, 1)  # drivers and ROS print; that must not mix with messages
    stopping = threading.Event()
    kind, *arguments = sys.argv[1:]
    pipeline = read_text() if kind == "gstreamer" else ""
    patience_s = _END_S if kind == "gstreamer" else 0.0
    threading.Thread(target=_await_end, args=(stopping, patience_s), daemon=True).start()
    try:
        try:
            if kind == "gstreamer":
                run(pipeline, arguments[0], output, stopping)
            else:
                topic, info_topic, stamps = arguments
                listen(topic, info_topic, stamps, output)
        except (ImportError, _NoImagesError) as error:
            reason = NO_ROS if getattr(error, "name", None) == "rclpy" else str(error).splitlines()[0]
            send(output, ERROR, data=reason.encode())
    except BrokenPipeError:
        pass  # the parent has closed the pipe
    os._exit(0)  # threads of drivers may hang


def packed_text(text: str) -> bytes:
    """A text in the form that `read_text` reads."""
    data = text.encode()
    return LENGTH.pack(len(data)) + data


def read_text() -> str:
    """A text written with `packed_text`; empty if the pipe was closed."""
    with open(0, "rb", buffering=0, closefd=False) as source:
        header = _exactly(source, LENGTH.size)
        return _exactly(source, LENGTH.unpack(header)[0] if len(header) == LENGTH.size else 0).decode()


def _exactly(source: Any, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := source.read(size - len(data))):
        data += more
    return data


def _await_end(stopping: threading.Event, patience_s: float) -> None:
    while os.read(0, 1):
        pass
    stopping.set()
    time.sleep(patience_s)
    os._exit(1)


def run(pipeline_text: str, caps: str, output: int, stopping: threading.Event) -> None:
    """Writes all images to the file descriptor ``output``. Raises _NoImagesError."""
    gst = _library("libgstreamer-1.0.so.0", _GST)
    app = _library("libgstapp-1.0.so.0", _APP)
    gst.gst_init(None, None)
    error = POINTER(_Error)()
    pipeline = gst.gst_parse_launch(b"%s ! appsink name=%s" % (pipeline_text.encode(), _SINK), byref(error))
    if error:
        raise _NoImagesError(f"cannot be built ({_text(error)})")
    sink = gst.gst_bin_get_by_name(pipeline, _SINK)
    for key, value in (("caps", caps), ("max-buffers", "2"), ("drop", "true"), ("qos", "false")):
        gst.gst_util_set_object_arg(sink, key.encode(), value.encode())
    gst.gst_pipeline_use_clock(pipeline, gst.gst_system_clock_obtain())  # CLOCK_MONOTONIC
    try:
        _start(gst, pipeline, sink)
        _forward(gst, app, pipeline, sink, output, stopping)
    finally:
        gst.gst_element_set_state(pipeline, _NULL)


def _start(gst: ctypes.CDLL, pipeline: int, sink: int) -> None:
    """Starts the pipeline. Live images are read as they come, those of a file at their times."""
    changed = gst.gst_element_set_state(pipeline, _PAUSED)
    if changed not in (_FAILED, _LIVE):
        changed = gst.gst_element_get_state(pipeline, None, None, _PREROLL_NS)
    if changed == _FAILED:
        raise _NoImagesError(_failure(gst, pipeline) or "cannot be started")
    gst.gst_util_set_object_arg(sink, b"sync", b"false" if changed == _LIVE else b"true")
    if gst.gst_element_set_state(pipeline, _PLAYING) == _FAILED:
        raise _NoImagesError(_failure(gst, pipeline) or "cannot be started")


def _forward(
    gst: ctypes.CDLL, app: ctypes.CDLL, pipeline: int, sink: int, output: int, stopping: threading.Event
) -> None:
    known = None
    while not stopping.is_set():
        failure = _failure(gst, pipeline)
        if failure is not None:
            raise _NoImagesError(failure)
        sample = app.gst_app_sink_try_pull_sample(sink, _LOOK_NS)
        if not sample:
            if app.gst_app_sink_is_eos(sink):
                send(output, END)
                return
            continue
        caps = _caps(gst, sample)
        if caps != known:
            send(output, CAPS, data=caps)
            known = caps
        _send_image(gst, pipeline, sample, output)
        gst.gst_mini_object_unref(sample)


def _send_image(gst: ctypes.CDLL, pipeline: int, sample: int, output: int) -> None:
    buffer = gst.gst_sample_get_buffer(sample)
    stamp = Buffer.from_address(buffer).pts
    running = gst.gst_segment_to_running_time(gst.gst_sample_get_segment(sample), _TIME, stamp)
    time_ns = NO_TIME if _NONE in (stamp, running) else gst.gst_element_get_base_time(pipeline) + running
    flags = DAMAGED if gst.gst_buffer_has_flags(buffer, _CORRUPTED) else 0
    mapped = _Map()
    if not gst.gst_buffer_map(buffer, byref(mapped), _READ):
        raise _NoImagesError("gives images that cannot be read; end it with an element that copies them to main memory")
    try:
        send(output, IMAGE, flags, time_ns, (ctypes.c_char * mapped.size).from_address(mapped.data))
    finally:
        gst.gst_buffer_unmap(buffer, byref(mapped))


def send(
    output: int, kind: bytes, flags: int = 0, time_ns: int = 0, data: bytes | ctypes.Array[ctypes.c_char] = b""
) -> None:
    """Writes one message. Raises BrokenPipeError if the parent has closed the pipe."""
    view = memoryview(data).cast("B")
    _write(output, memoryview(HEADER.pack(kind, flags, time_ns, len(view))))
    _write(output, view)


def _write(output: int, data: memoryview) -> None:
    while data:
        data = data[os.write(output, data) :]


def _caps(gst: ctypes.CDLL, sample: int) -> bytes:
    text = gst.gst_caps_to_string(gst.gst_sample_get_caps(sample))
    try:
        return bytes(ctypes.cast(text, c_char_p).value or b"")
    finally:
        gst.g_free(text)


def _failure(gst: ctypes.CDLL, pipeline: int) -> str | None:
    """Why an element has failed; None: no element has."""
    bus = gst.gst_element_get_bus(pipeline)
    message = gst.gst_bus_pop_filtered(bus, _ERROR)
    gst.gst_object_unref(bus)
    if not message:
        return None
    error, detail = POINTER(_Error)(), c_char_p()
    gst.gst_message_parse_error(message, byref(error), byref(detail))
    return f"has failed ({_text(error)})"


def _text(error: Any) -> str:
    return bytes(error.contents.message or b"no reason given").decode("utf-8", "replace").strip().rstrip(".")


_GST: Mapping[str, tuple[Any, ...]] = {
    "g_free": (None, c_void_p),
    "gst_buffer_has_flags": (c_int, c_void_p, c_int),
    "gst_buffer_map": (c_int, c_void_p, c_void_p, c_int),
    "gst_buffer_unmap": (None, c_void_p, c_void_p),
    "gst_bin_get_by_name": (c_void_p, c_void_p, c_char_p),
    "gst_bus_pop_filtered": (c_void_p, c_void_p, c_int),
    "gst_caps_to_string": (c_void_p, c_void_p),
    "gst_element_get_base_time": (c_uint64, c_void_p),
    "gst_element_get_bus": (c_void_p, c_void_p),
    "gst_element_get_state": (c_int, c_void_p, c_void_p, c_void_p, c_uint64),
    "gst_element_set_state": (c_int, c_void_p, c_int),
    "gst_init": (None, c_void_p, c_void_p),
    "gst_message_parse_error": (None, c_void_p, c_void_p, c_void_p),
    "gst_mini_object_unref": (None, c_void_p),
    "gst_object_unref": (None, c_void_p),
    "gst_parse_launch": (c_void_p, c_char_p, c_void_p),
    "gst_pipeline_use_clock": (None, c_void_p, c_void_p),
    "gst_sample_get_buffer": (c_void_p, c_void_p),
    "gst_sample_get_caps": (c_void_p, c_void_p),
    "gst_sample_get_segment": (c_void_p, c_void_p),
    "gst_segment_to_running_time": (c_uint64, c_void_p, c_int, c_uint64),
    "gst_system_clock_obtain": (c_void_p,),
    "gst_util_set_object_arg": (None, c_void_p, c_char_p, c_char_p),
}
"""Result and arguments of each function."""
_APP: Mapping[str, tuple[Any, ...]] = {
    "gst_app_sink_is_eos": (c_int, c_void_p),
    "gst_app_sink_try_pull_sample": (c_void_p, c_void_p, c_uint64),
}


def _library(name: str, signatures: Mapping[str, tuple[Any, ...]]) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(name)
    except OSError as error:
        raise _NoImagesError(NOT_INSTALLED) from error
    for function, (result, *arguments) in signatures.items():
        pointer = getattr(library, function)
        pointer.restype, pointer.argtypes = result, arguments
    return library


def listen(topic: str, info_topic: str, stamps: str, output: int) -> None:
    """Writes all images of a topic, without end. Raises ImportError and _NoImagesError."""
    import rclpy  # noqa: PLC0415 - of ROS 2
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: PLC0415

    rclpy.init()
    node = rclpy.create_node(f"flockd_camera_{os.getpid()}")
    kind, name, reliable = _wait_for(node, topic)
    messages = importlib.import_module("sensor_msgs.msg")
    best = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
    offered = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE) if reliable else best
    clock = _Clock()
    if stamps == "simulator":
        kept = importlib.import_module("rosgraph_msgs.msg").Clock
        node.create_subscription(kept, "/clock", lambda now: clock.take(_ns(now.clock)), best)

    def take(message: Any) -> None:
        time_ns = clock.monotonic_ns(_ns(message.header.stamp), simulated=stamps == "simulator")
        send(output, kind, 0, time_ns, packed(message))

    node.create_subscription(getattr(messages, name), topic, take, offered)
    node.create_subscription(messages.CameraInfo, info_topic, lambda info: send(output, INFO, data=body_of(info)), best)
    rclpy.spin(node)


def packed(message: Any) -> bytes:
    """The data of an `imag` or `jpeg` message."""
    if hasattr(message, "encoding"):
        head = IMAGE_HEAD.pack(message.encoding.encode(), message.width, message.height, message.step)
    else:
        head = IMAGE_HEAD.pack(message.format.encode(), 0, 0, 0)
    return head + bytes(message.data)


def body_of(info: Any) -> bytes:
    """The data of an `info` message."""
    return INFO_BODY.pack(*numbers_of(info))


def numbers_of(info: Any) -> tuple[float, ...]:
    """Width, height; fx, fy, cx, cy; five coefficients, NaN for none or more; whether of a fisheye."""
    fx, _, cx, _, fy, cy, *_ = info.k
    k = [float("nan")] * 5 if not 0 < len(info.d) <= 5 else [*info.d, *[0.0] * (5 - len(info.d))]
    return info.width, info.height, fx, fy, cx, cy, *k, info.distortion_model in {"equidistant", "fisheye"}


def _wait_for(node: Any, topic: str) -> tuple[bytes, str, bool]:
    """Waits for publishers: the message kind, the type's name, and whether all publishers are reliable."""
    from rclpy.qos import ReliabilityPolicy  # noqa: PLC0415

    while True:
        known = [one for one in node.get_publishers_info_by_topic(topic) if one.topic_type]
        kinds = {one.topic_type for one in known}
        if kinds - IMAGES.keys():
            raise _NoImagesError(f"is of {sorted(kinds - IMAGES.keys())[0]}")
        if kinds:
            reliable = all(one.qos_profile.reliability == ReliabilityPolicy.RELIABLE for one in known)
            return *IMAGES[sorted(kinds)[0]], reliable
        time.sleep(_TOPIC_LOOK_S)


class _Clock:
    """Converts time stamps to CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        self._readings: deque[tuple[int, int]] = deque()
        """Arrival time of each reading of a simulator's clock, and arrival time minus reading."""

    def take(self, stamp_ns: int) -> None:
        now_ns = time.monotonic_ns()
        self._readings.append((now_ns, now_ns - stamp_ns))
        while now_ns - self._readings[0][0] > _CLOCK_S * 1e9:
            self._readings.popleft()

    def monotonic_ns(self, stamp_ns: int, *, simulated: bool) -> int:
        """An image's stamp, ns of CLOCK_MONOTONIC; `NO_TIME` before the first reading of a simulator's clock."""
        if not simulated:
            return stamp_ns + time.monotonic_ns() - time.time_ns()
        if not self._readings:
            return NO_TIME
        return stamp_ns + min(behind for _, behind in self._readings)


def _ns(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


if __name__ == "__main__":
    main()
