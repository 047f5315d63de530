"""Every target by its name."""

from __future__ import annotations

from tools.fuzzing.files import TARGETS as FILES
from tools.fuzzing.flight import TARGETS as FLIGHT
from tools.fuzzing.messages import TARGETS as MESSAGES

TARGETS = {target.name: target for target in (*FILES, *MESSAGES, *FLIGHT)}
