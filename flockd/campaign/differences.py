"""What differs between two configurations, key by key."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any


def differences(first: Any, second: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Keys, dotted, whose values differ, each with both values as JSON; of a key that only one has, `null`."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for name in dict.fromkeys([*first, *second]):
            yield from differences(first.get(name), second.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(first) != json.dumps(second):
        yield key, json.dumps(first), json.dumps(second)
