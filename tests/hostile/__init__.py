"""Inputs that nobody would write, against every place where flockd reads what comes from outside, and what flies.

Hypothesis makes the choices: the same each time, and a failure is shrunk to its simplest. Inputs are valid ones,
changed where it hurts most: lines, JSON values, records behind correct checksums, bytes. A test fails on an error that
is not one of flockd's own, a text that no terminal should get, an input that takes 5 s, and memory over 1 GiB. The
seconds are this process's own, so that a busy computer adds none; a minute of any clock is too much as well.
`pytest --hypothesis-profile=many -k "hostile or properties or any_networks"` tries a hundred times as many, others each
time.
"""

from __future__ import annotations

import copy
import math
import os
import resource
import struct
import time
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from random import Random
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flockd.core.errors import FlockdError
from flockd.core.printable import printable

ROOT = Path(__file__).resolve().parents[2]
CORPUS = Path(__file__).parent / "corpus"
LONGEST_ERROR = 20_000
"""Characters that an error may tell a person."""
MEMORY_BYTES = 1 << 30
"""Above what the process has before an input."""
LONGEST_S = 5.0
"""Of this process's own time, for an input."""


def hostile(inputs: int) -> Callable[[Callable[[Random], None]], Callable[[], None]]:
    """A check of so many inputs, which it makes of Hypothesis' choices; the profile `many` tries a hundredfold.

    One more comes first and may take longer: numba compiles then.
    """
    several = settings(
        max_examples=inputs * settings().max_examples // 100, deadline=timedelta(minutes=1), database=None,
        derandomize=settings().max_examples <= 100, suppress_health_check=list(HealthCheck),
    )  # fmt: skip

    def decorated(check: Callable[[Random], None]) -> Callable[[], None]:
        def in_time(random: Random) -> None:
            began_s = time.process_time()
            check(random)
            assert time.process_time() - began_s < LONGEST_S

        tried: Callable[[], None] = several(given(st.randoms(use_true_random=False))(in_time))

        def first_and_others() -> None:
            check(Random(0))
            tried()

        return first_and_others

    return decorated


@contextmanager
def own_errors() -> Iterator[None]:
    """Lets pass what flockd says in sentences of its own, if a person can read them; bounds the memory."""
    limit = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY_BYTES, limit[1]))
    try:
        yield
    except FlockdError as error:
        assert_readable(str(error))
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limit)


def assert_readable(text: str) -> None:
    """Raises AssertionError for a text that is no good on a terminal."""
    shown = printable(text)  # as every command does
    odd = {char for char in shown if char not in "\n\t" and unicodedata.category(char) in ("Cc", "Cf", "Cs")}
    assert not odd, f"control characters {sorted(odd)!a} reach the terminal"
    assert 0 < len(text) <= LONGEST_ERROR, f"an error has {len(text)} characters"


def odd_file(random: Random, path: Path, *, folders: bool = True) -> None:
    """Puts something in a file's place that is no ordinary file: who opens it may wait for ever."""
    path.unlink(missing_ok=True)
    match random.randrange(4 if folders else 3):
        case 0:
            os.mkfifo(path)
        case 1:
            path.symlink_to("/dev/zero")
        case 2:
            path.symlink_to("nowhere")
        case _:
            path.mkdir()


def removed(path: Path) -> None:
    """Removes what `odd_file` may have put there."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


def text_of(random: Random, texts: Sequence[str]) -> bytes:
    """One of them, with lines or bytes changed."""
    text = random.choice(texts)
    if random.random() < 0.7:
        text = mutated_lines(random, text)
    data = text.encode("utf-8", "surrogatepass")
    return mutated_bytes(random, data) if random.random() < 0.4 else data


def put(random: Random, path: Path, content: Callable[[], bytes]) -> None:
    """Now and then something else than a file, or deep nesting in one."""
    removed(path)
    odd = random.random()
    if odd < 0.01:
        odd_file(random, path)
    else:
        path.write_bytes(nested(random) if odd < 0.02 else content())


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


def mutated_bytes(random: Random, data: bytes) -> bytes:
    """One to eight runs deleted, cut off, or replaced: by bits turned, bytes, a number, or another run."""
    for _ in range(random.choice((1, 1, 2, 4, 8))):
        at, other = random.randrange(len(data) + 1), random.randrange(len(data) + 1)
        length = random.choice((0, 1, 2, 4, 8, 64, 1024, len(data) if random.random() < 0.05 else 1))
        number = struct.pack("<Q", int(random.choice((0, 1, 2**31, 2**32, 2**63, 2**64 - 1, len(data)))))
        turned = bytes(byte ^ 1 << random.randrange(8) for byte in data[at : at + 1])
        some = random.choice((b"", turned, number[:length], random.randbytes(min(length, 8)), data[other:][:length]))
        data = data[:at] + some + data[at + length :]
    return data


def nested(random: Random) -> bytes:
    """JSON, and nearly YAML, that is nested deeply: more than a person writes, or more than a stack takes."""
    depth = random.choice((40, 200, 900, 5_000, 100_000))
    opened, closed = random.choice(((b"[", b"]"), (b'{"a":', b"}"), (b'[{"a":', b"}]")))
    return opened * depth + b"1" + closed * (depth if random.random() < 0.7 else 0)


def mutated_lines(random: Random, text: str) -> str:
    """One to four changes of lines: deleted, doubled, moved, indented otherwise, another value, another word."""
    lines = text.split("\n")
    for _ in range(random.choice((1, 1, 2, 4))):
        at, count, other = random.randrange(len(lines)), random.choice((1, 1, 3, 5)), random.randrange(len(lines))
        line, run = lines[at], lines[at : at + count]
        words, key = line.split(" "), line.partition(":")[0]
        words[random.randrange(len(words))] = _written(random)
        indented = random.choice((" ", "    ", "\t", "- ")) + line
        changed = random.choice((indented, line[1:], f"{key}: {_written(random)}", " ".join(words)))
        moved = lines[other : other + count]
        lines[at : at + count] = random.choice(([], run * 2, run * 50, moved, *[[changed, *run[1:]]] * 4))
        lines = lines or [""]
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
