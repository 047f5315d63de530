"""Every target by its name."""

from __future__ import annotations

from tools.checks.fuzzing.files import TARGETS as FILES
from tools.checks.fuzzing.flight import TARGETS as FLIGHT
from tools.checks.fuzzing.messages import TARGETS as MESSAGES

TARGETS = {target.name: target for target in (*FILES, *MESSAGES, *FLIGHT)}
