"""Worlds are generated once."""

from tests.worlds import worlds_once

__all__ = ["worlds_once"]
