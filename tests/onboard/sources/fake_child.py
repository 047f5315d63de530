"""Speaks like the process of a camera; nothing of flockd's is imported here.

fake_child.py gstreamer CAPS    # and over standard input the length of the words, four bytes, and the words
fake_child.py FILE ros ...      # each line of the file is JSON: kind, and the message in hexadecimal digits

Of a file's messages `"ms"` is how long before the first one it was taken; without, now. Words are those of a pipeline:
`caps:WxH` and `caps:text` say what the images are; `N` sends N different images of 64x48 in RGB, 20 ms apart.
`short` sends one that lacks a byte, `flagged` one the driver calls damaged, `untimed` one without a time. `stall` waits
until the other side goes, `fail:text` and `end` say so, `print` prints a line, `crash` ends by a signal, `once:FILE`
skips the word after it if FILE exists, and makes it. Underscores in texts are spaces.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

WIDTH, HEIGHT = 64, 48
PERIOD_S = 0.02


def send(kind: bytes, data: bytes = b"", flags: int = 0, time_ns: int = 0) -> None:
    """The header as the protocol has it, by hand: kind, flags, nanoseconds, length, four bytes of nothing."""
    view = memoryview(struct.pack("<4sIqI", kind, flags, time_ns, len(data)) + bytes(4) + data)
    while view:
        view = view[os.write(1, view) :]


def picture(number: int) -> bytes:
    """A gradient whose first pixel is the number."""
    row = bytes(value % 256 for column in range(WIDTH) for value in (column * 3, column, 255 - column))
    return bytes([number % 256]) * 3 + row[3:] + row * (HEIGHT - 1)


def images(count: int) -> None:
    """Stamped as they are sent."""
    for number in range(count):
        send(b"imag", picture(number), time_ns=time.monotonic_ns())
        time.sleep(PERIOD_S)


def say_caps(text: str) -> None:
    """Says the caps: RGB where only a size is given."""
    width, _, height = text.partition("x")
    raw = f"video/x-raw, format=(string)RGB, width=(int){width}, height=(int){height}, framerate=(fraction)50/1"
    send(b"caps", (raw if width.isdigit() else text.replace("_", " ")).encode())


WORDS: dict[str, Callable[[str], object]] = {
    "caps": say_caps,
    "short": lambda _: send(b"imag", picture(0)[:-1], time_ns=time.monotonic_ns()),
    "flagged": lambda _: send(b"imag", picture(0), flags=1, time_ns=time.monotonic_ns()),
    "untimed": lambda _: send(b"imag", picture(0), time_ns=-1),
    "stall": lambda _: sys.stdin.read(),
    "fail": lambda text: send(b"fail", text.replace("_", " ").encode()),
    "end": lambda _: send(b"end\0"),
    "print": lambda _: os.write(1, b"GST_ARGUS: Creating output stream, and more of the kind\n"),
    "crash": lambda _: os.kill(os.getpid(), signal.SIGSEGV),
}


def play(words: list[str]) -> None:
    """One after the other; then the end of the program."""
    while words:
        word, _, text = words.pop(0).partition(":")
        if word.isdigit():
            images(int(word))
        elif word == "once":
            if Path(text).exists():
                words.pop(0)
            Path(text).touch()
        else:
            WORDS[word](text)


def send_messages(file: Path) -> None:
    """All of them; then it stalls."""
    began_ns = time.monotonic_ns()
    for one in map(json.loads, file.read_text(encoding="ascii").splitlines()):
        time_ns = began_ns - 10**6 * one["ms"] if "ms" in one else time.monotonic_ns()
        send(one["kind"].encode(), bytes.fromhex(one["data"]), time_ns=time_ns)
        time.sleep(PERIOD_S)
    sys.stdin.read()


if sys.argv[1] == "gstreamer":
    (length,) = struct.unpack("<I", os.read(0, 4))
    play(os.read(0, length).decode().split())
else:
    send_messages(Path(sys.argv[1]))
