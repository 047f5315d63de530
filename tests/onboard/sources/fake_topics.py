"""Speaks like the process that listens to a camera's topics: writes a file's messages, stamps them, and stalls.

fake_topics.py FILE TOPIC CAMERA_INFO_TOPIC STAMPS. The file is a list of JSON: kind, and the message in hexadecimal
digits. `"ms"` is how long before the first message it was taken; without, now.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import time
from pathlib import Path


def main() -> None:
    """Writes all, then stalls."""
    began_ns = time.monotonic_ns()
    for line in Path(sys.argv[1]).read_text(encoding="ascii").splitlines():
        one = json.loads(line)
        data = bytes.fromhex(one["data"])
        time_ns = began_ns - 10**6 * one["ms"] if "ms" in one else time.monotonic_ns()
        left = memoryview(struct.pack("<4sIqI", one["kind"].encode(), 0, time_ns, len(data)) + bytes(4) + data)
        while left:
            left = left[os.write(1, left) :]
        time.sleep(0.02)
    sys.stdin.read()


if __name__ == "__main__":
    main()
