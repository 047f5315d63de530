"""A person upgrades, writes what was there before, and is told in a sentence what to use instead."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.cli import main
from flockd.core.gone import COMMANDS, KEYS
from tests.conftest import Told

_CONFIG = Path(__file__).parents[2] / "config"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_is_gone_is_refused_with_what_to_use(command: str, told: Told) -> None:
    program, *words = command.split()
    assert program == "flockd"
    assert f"{words[-1]} is gone; {COMMANDS[command]}" in told(2, *words, "value")


@pytest.mark.parametrize("key", KEYS)
def test_a_key_that_is_gone_is_refused_with_its_line_and_what_to_use(
    key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    *sections, name = key.split(".")
    values: Any = yaml.safe_load((_CONFIG / "simulator.yaml").read_text(encoding="utf-8"))
    inner = values
    for section in sections:
        inner = inner.setdefault(section, {})
        inner = inner[0] if isinstance(inner, list) else inner
    assert name not in inner
    inner[name] = 1
    path = tmp_path / "file.yaml"
    text = yaml.safe_dump(values)
    path.write_text(text, encoding="utf-8")
    (line,) = (number for number, one in enumerate(text.splitlines(), 1) if one.strip() == f"{name}: 1")
    assert main(["config", "check", str(path)]) == 78
    shown = key.replace("rig.cameras.", "rig.cameras[0].")
    assert f"{path}:{line}: {shown}: is gone; {KEYS[key]}\n" in capsys.readouterr().err
