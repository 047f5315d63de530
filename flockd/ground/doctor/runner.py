"""Runs checks one after the other, each bounded in time: one that hangs or breaks is a failure that says so."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass

from flockd.core.errors import FlockdError
from flockd.ground.doctor.finding import Finding, failed, failed_from_error


@dataclass(frozen=True)
class Check:
    """One check of the doctor."""

    name: str
    run: Callable[[], Iterable[Finding]]
    """Changes nothing; what it finds counts even if it hangs later."""
    limit_s: float
    """Much longer than it should take."""


def run_checks(checks: Sequence[Check], on_done: Callable[[int, int], None]) -> dict[str, tuple[Finding, ...]]:
    """What each check found, by its name; ``on_done`` is called with how many of how many are done."""
    found = {}
    for number, check in enumerate(checks, start=1):
        found[check.name] = _bounded(check)
        on_done(number, len(checks))
    return found


def _bounded(check: Check) -> tuple[Finding, ...]:
    found: list[Finding] = []
    ended: Future[None] = Future()

    def run() -> None:
        try:
            found.extend(check.run())
        except BaseException as error:  # noqa: BLE001 - reported below, whatever it is
            ended.set_exception(error)
        else:
            ended.set_result(None)

    threading.Thread(target=run, name=f"check {check.name}", daemon=True).start()
    if not wait([ended], check.limit_s).done:
        measured = f"the check has not ended within {check.limit_s:g} s"
        fix = "a device or service does not respond: read this check's other findings and the kernel's log (`dmesg`)"
        return (*found, failed(check.name, measured, fix))
    error = ended.exception()
    return tuple(found) if error is None else (*found, _of_error(check.name, error))


def _of_error(about: str, error: BaseException) -> Finding:
    """The failure that an error means."""
    if isinstance(error, FlockdError):
        return failed_from_error(about, str(error))
    if isinstance(error, ImportError):
        return failed(about, f"a library cannot be loaded ({error})", "install flockd again, for this computer")
    if isinstance(error, OSError):
        return failed(about, f"{error.filename or 'the system'}: {error.strerror or error}", "check that it responds")
    return failed(
        about, f"the check itself failed ({error!r})", "report it to flockd's developers, with your configuration"
    )
