"""`flockd report`: the report of a recorded flight."""

from __future__ import annotations

import argparse
from pathlib import Path
from zipfile import BadZipFile

from flockd.cli.flights import LOG_NAME, tell, write_findings
from flockd.cli.parser import Commands
from flockd.errors import UsageError


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = ("flockd report out/paper_flight-learned-seed0", "flockd report --json DIR")
    parser = commands("report", "Write the summary and the report of a flight again, from its log.", examples)
    parser.add_argument("directory", metavar="DIR", type=Path, help="folder that `flockd sim` wrote")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    path = args.directory / LOG_NAME
    if not path.is_file():
        raise UsageError(f"{path}: does not exist; name a folder that `flockd sim` wrote")
    from flockd.sim.log import FlightLog

    try:
        log = FlightLog.load(path)
    except (ValueError, EOFError, BadZipFile) as error:
        raise UsageError(f"{path}: is not a whole flight log ({error}); fly again with `flockd sim`") from error
    return tell(args.directory, write_findings(args.directory, log), as_json=args.json)
