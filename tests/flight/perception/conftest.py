"""What several tests of perception begin with."""

from __future__ import annotations

from tests.flight.inference.conftest import copies

__all__ = ["copies"]
