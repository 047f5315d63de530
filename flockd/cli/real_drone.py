"""The option `--force` of commands that take a real drone's configuration: fly outside the proven envelope."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.output import complain
from flockd.cli.parser import Parser
from flockd.core.errors import ConfigError, ConfigProblem

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig


def add_force(parser: Parser) -> None:
    """Adds the option."""
    parser.add_argument("--force", action="store_true", help="take speeds beyond those that were shown to be safe")


def load_to_fly(file: Path, *, force: bool) -> DroneConfig:
    """What the drone flies with. Raises ConfigError, also for what is outside the envelope, unless that is forced."""
    from flockd.core.config import load_real_drone

    config, outside = load_real_drone(file)
    permit(outside, force=force)
    return config


def permit(outside: Sequence[ConfigProblem], *, force: bool) -> None:
    """Warns of what is outside the envelope where that is forced, else raises it as ConfigError."""
    if outside and not force:
        raise ConfigError(outside)
    for problem in outside:
        complain(f"warning: {str(problem).rpartition('; ')[0]}; --force goes beyond it")
