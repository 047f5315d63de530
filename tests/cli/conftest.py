"""`flockd` as a person runs it, in this process."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from flockd.cli import main

Told = Callable[..., str]
"""Its exit code and its arguments: what stands on stdout, or the one sentence on stderr."""


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Told:
    def run(code: int, *arguments: object) -> str:
        capsys.readouterr()
        try:
            ended = main([str(argument) for argument in arguments])
        except SystemExit as exit_:
            ended = int(exit_.code or 0)
        captured = capsys.readouterr()
        assert ended == code, captured.err
        assert code == 0 or (captured.out, captured.err.count("\n")) == ("", 1), captured
        return captured.err if code else captured.out

    return run
