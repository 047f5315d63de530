"""Changes of bytes, lines and JSON that parsers are likeliest to stumble over. All randomness comes from the caller."""

from __future__ import annotations

import copy
import math
import struct
from random import Random
from typing import Any

Json = Any

ABSURD_NUMBERS: tuple[int | float, ...] = (
    *(0, -1, 1, 2, 127, 128, 255, 256, -32768, 65535, 2**31 - 1, 2**31, -(2**31), 2**32, 2**53 + 1),
    *(2**63 - 1, 2**63, -(2**63) - 1, 2**64, 10**30, 10**400, 0.0, -0.0, 0.1, 1e-163, 5e-324, 1e-9, 1e9, 1e154, 1e308),
    *(-1e308, 1.5e308, 1.7e308, 3.5e38, -3.5e38, 1e19, 1e300, math.inf, -math.inf, math.nan),
)
ABSURD_TEXTS = (
    *("", " ", "\0", "\x1b[2J\x1b[31m", "\x9b", "\u202e", "é", "\U0001f681", "a" * 5000, "nan", "inf", "null", "true"),
    *("~", "../../..", "/dev/zero", "/", "no such file", "1e999", "0x10", "1_000", "²", "12:30", "- ", "[", "{", "}"),
    *("&a", "*a", "!!python/name:os.system", "!!binary AA==", "\t", "%", "%YAML 9.9", "---", "...", '"', "'", "|", ">"),
    *(": ", "#", "\ud800", "a\udfff", '"\\ud800"', '"a\\0b"'),
)
INTERESTING_BYTES = (0, 1, 9, 10, 13, 27, 32, 34, 39, 44, 45, 58, 91, 93, 123, 125, 127, 128, 192, 237, 255)


def mutated_bytes(random: Random, data: bytes) -> bytes:
    """One to eight changes: bits, bytes, numbers of 2 to 8 bytes, runs deleted, doubled, moved, or cut off."""
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4, 8))):
        at = random.randrange(len(changed) + 1)
        length = min(random.choice((1, 2, 4, 8, 64, 1024)), len(changed) - at)
        match random.randrange(8):
            case 0 if length:
                changed[at] ^= 1 << random.randrange(8)
            case 1 if length:
                changed[at] = random.choice(INTERESTING_BYTES)
            case 2:
                number = struct.pack("<Q", int(random.choice((0, 1, 2**31, 2**32, 2**63, 2**64 - 1, len(changed)))))
                changed[at : at + 8] = number[: random.choice((2, 4, 8))]
            case 3:
                del changed[at : at + length]
            case 4:
                changed[at:at] = changed[at : at + length]
            case 5:
                changed[at:at] = bytes(random.choice(INTERESTING_BYTES) for _ in range(random.randrange(1, 9)))
            case 6:
                other = random.randrange(len(changed) + 1)
                changed[at:at] = changed[other : other + length]
            case 7 if random.random() < 0.2:
                del changed[at:]
    return bytes(changed)


def nested(random: Random) -> bytes:
    """JSON, and nearly YAML, that is nested deeply: more than a person writes, or more than a stack takes."""
    depth = random.choice((40, 200, 900, 5_000, 100_000))
    opened, closed = random.choice(((b"[", b"]"), (b'{"a":', b"}"), (b'[{"a":', b"}]")))
    return opened * depth + b"1" + closed * (depth if random.random() < 0.7 else 0)


def mutated_lines(random: Random, text: str) -> str:
    """One to four changes of lines: deleted, doubled, moved, indented otherwise, another value, another key."""
    lines = text.split("\n")
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(len(lines))
        line = lines[at]
        match random.randrange(8):
            case 0:
                del lines[at : at + random.choice((1, 1, 3))]
                lines = lines or [""]
            case 1:
                lines[at:at] = lines[at : at + random.choice((1, 1, 5))] * random.choice((1, 1, 50))
            case 2:
                lines.insert(random.randrange(len(lines) + 1), line)
            case 3:
                lines[at] = random.choice((" ", "  ", "    ", "\t", "- ")) + line
            case 4:
                lines[at] = line.lstrip() if random.random() < 0.5 else line[1:]
            case 5 | 6:
                key, colon, _ = line.partition(":")
                lines[at] = f"{key}{colon or ':'} {_written(random)}"
            case 7:
                words = line.split(" ")
                words[random.randrange(len(words))] = _written(random)
                lines[at] = " ".join(words)
    return "\n".join(lines)


def _written(random: Random) -> str:
    """A value as somebody may write it."""
    match random.randrange(4):
        case 0:
            return str(random.choice(ABSURD_NUMBERS))
        case 1:
            return random.choice(ABSURD_TEXTS)
        case 2:
            return "[" + ", ".join(str(random.choice(ABSURD_NUMBERS)) for _ in range(random.randrange(5))) + "]"
        case _:
            return "{" + f"{random.choice(ABSURD_TEXTS)}: {random.choice(ABSURD_NUMBERS)}" + "}"


def absurd(random: Random) -> Json:
    """A value of any of JSON's types."""
    match random.randrange(7):
        case 0 | 1 | 2:
            return random.choice(ABSURD_NUMBERS)
        case 3:
            return random.choice(ABSURD_TEXTS)
        case 4:
            return random.choice((None, True, False))
        case 5:
            return [absurd(random) for _ in range(random.randrange(4))]
        case _:
            return {str(random.choice(ABSURD_TEXTS)): absurd(random) for _ in range(random.randrange(3))}


def mutated_json(random: Random, value: Json) -> Json:
    """A copy with one to three values replaced, deleted, doubled or wrapped."""
    changed = copy.deepcopy(value)
    for _ in range(random.choice((1, 1, 2, 3))):
        changed = _changed_somewhere(random, changed)
    return changed


def _changed_somewhere(random: Random, value: Json) -> Json:
    holder: Json = None
    key: Json = None
    here = value
    while isinstance(here, dict | list) and here and (holder is None or random.random() < 0.8):
        holder, key = here, random.choice(list(here)) if isinstance(here, dict) else random.randrange(len(here))
        here = here[key]
    if holder is None:
        return absurd(random)
    match random.randrange(5):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, list):
            holder.insert(key, copy.deepcopy(here))
        case 2:
            holder[key] = [here] if random.random() < 0.5 else {"x": here}
        case _:
            holder[key] = absurd(random)
    return value


def any_float(random: Random) -> float:
    """Small numbers most of the time, absurd ones now and then."""
    if random.random() < 0.15:
        if random.random() < 0.3:  # finite, and somewhere between what is usual and the largest
            return random.choice((-1.0, 1.0)) * math.pow(10.0, random.uniform(3.0, 308.0))
        number = random.choice(ABSURD_NUMBERS)
        return float(number) if abs(number) < 1e300 or isinstance(number, float) else math.inf
    return random.choice((0.01, 0.1, 1.0, 3.0, 10.0, 100.0)) * random.uniform(-1.0, 1.0)
