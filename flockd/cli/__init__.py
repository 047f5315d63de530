"""The command line: `flockd COMMAND ...`."""
# PYTHON_ARGCOMPLETE_OK

from __future__ import annotations

import atexit
import errno
import importlib.util
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from flockd import __version__
from flockd.cli import (
    calibrate,
    cameras,
    campaign,
    config,
    detect,
    doctor,
    fleet,
    models,
    record,
    replay,
    report,
    ros,
    run,
    sim,
    status,
)  # fmt: skip
from flockd.cli.output import complain
from flockd.cli.parser import Parser, commands_of, require
from flockd.core.errors import ExitCode, FlockdError, UnavailableError, shortage_of
from flockd.core.jpeg_header import MAX_IMAGE_PIXELS

# Packages of an extra: without them a command is unavailable, not broken.
EXTRAS = {
    **dict.fromkeys(("numba", "llvmlite", "matplotlib", "jinja2", "markupsafe", "pymavlink"), "sim"),
    "joblib": "campaign",
    "argcomplete": "completion",
    **dict.fromkeys(("aiohttp", "plotly"), "fleet"),
    "rosbags": "bags",
    "onnx": "models",
}

EXIT_CODES = """\
exit codes:
  0    done; also after Ctrl-C in what runs until then: run, fleet, status, ros, sim --live
  1    a check failed
  2    the command line is wrong, or a file that it names does not exist
  69   something is unavailable: an autopilot, a device, an optional package
  78   a configuration or a model is wrong
  130  interrupted by Ctrl-C; `sim` writes a report of what was flown, and `campaign` goes on later"""


def installing(extra: str) -> str:
    """How to install an extra: a pip command, which keeps a checkout editable.

    The Debian package has no pip, and its files are apt's.
    """
    if importlib.util.find_spec("pip") is None:
        return f"install flockd with the extra {extra} in an environment of its own, as docs/install.md does by hand"
    checkout = Path(__file__).parents[2]
    if (checkout / "pyproject.toml").is_file():
        return f"run: {sys.executable} -m pip install -e '{checkout}[{extra}]'"
    return f"run: {sys.executable} -m pip install 'flockd[{extra}]'"


def program() -> NoReturn:
    """Runs the installed `flockd`: calls `main`, then ends the process without Python's finalisation.

    In the finalisation a library's thread that still needs Python aborts the process by SIGABRT. The exit code would be
    lost, and a service manager would restart a drone that a wrong configuration had ended.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started flockd; a file that it writes would take its number
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - until the end
    if isinstance(sys.stdout, io.TextIOWrapper):  # as stderr does; not every terminal's encoding has every character
        sys.stdout.reconfigure(errors="backslashreplace")
    code = main()
    atexit._run_exitfuncs()  # what libraries have asked for; there is no public name
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code; an expected error is one sentence on stderr."""
    parser = _parser()
    if "_ARGCOMPLETE" in os.environ:  # a shell asks for completions of its command line
        import argcomplete

        argcomplete.autocomplete(parser)
    args, unknown = parser.parse_known_args(arguments)
    if unknown:
        args.parser.error(f"unknown argument {unknown[0]}")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_IMAGE_PIXELS))  # before OpenCV is imported
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # before ONNX Runtime is imported: it keeps statistics
    try:
        require(args)
        code: int = args.run(args)
        sys.stdout.flush()
    except FlockdError as error:
        return _failed(str(error), error.exit_code)
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        missing = UnavailableError(f"{error.name} is not installed; {installing(extra)}")
        return _failed(str(missing), missing.exit_code)
    except BrokenPipeError:  # the reader of our output has gone; Python would complain once more at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.DONE
    except KeyboardInterrupt:
        return _failed("interrupted", ExitCode.INTERRUPTED)
    except Exception as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # while a library in C++ was being imported
            return _failed("interrupted", ExitCode.INTERRUPTED)
        lacking = shortage_of(error)
        if lacking is not None:
            return _failed(f"out of {lacking}; raise the limits, or close other programs", ExitCode.UNAVAILABLE)
        if isinstance(error, OSError):
            remedy = "; check the path, its permissions and the disk" if error.filename else ""
            remedy = "; make room on the disk" if error.errno in {errno.ENOSPC, errno.EDQUOT} else remedy
            return _failed(f"{error.filename or 'the system'}: {error.strerror or error}{remedy}", ExitCode.UNAVAILABLE)
        raise
    return code


def _failed(sentence: str, code: int) -> int:
    complain(sentence)
    return code


def _parser() -> Parser:
    parser = Parser(
        prog="flockd",
        description="Drones that flock by sight alone.",
        examples=("flockd sim --duration 10 --drones 3", "flockd sim", "flockd config check config/paper_flight.yaml"),
        notes=EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"flockd {__version__}")
    commands = commands_of(parser)
    for command in (
        run, status, fleet, ros, doctor, sim, campaign, report, record, replay, detect, cameras, calibrate, config,
        models,
    ):  # fmt: skip
        command.add(commands)
    return parser
