"""`flockd record`: what is in a recording."""

from __future__ import annotations

import argparse

from flockd.cli.options import opened
from flockd.cli.output import say_facts
from flockd.cli.parser import Commands, commands_of, existing, flag, option


def add(commands: Commands) -> None:
    """Adds the command."""
    commands = commands_of(commands("record", "Inspect recordings.", ("flockd record info drone1.mcap",)))
    examples = ("flockd record info drone1.mcap", "flockd record info --json drone1.mcap")
    parser = commands("info", "Show the contents of a recording: duration, gaps, damage, messages.", examples, _info)
    option(parser, "RECORDING", "an MCAP file of flockd", existing)
    flag(parser, "--json", "print the result as JSON")


def _info(args: argparse.Namespace) -> int:
    from flockd.onboard.recording.reader import recording_info

    return say_facts(args, recording_info(opened(args.recording)))
