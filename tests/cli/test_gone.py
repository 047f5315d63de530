"""A person upgrades, writes what was there before, and is told in a sentence what to use instead."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.cli import main
from flockd.core.gone import COMMANDS, KEYS

_CONFIG = Path(__file__).parents[2] / "config"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_is_gone_is_refused_with_what_to_use(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, *words = command.split()
    with pytest.raises(SystemExit) as ended:
        main([*words, "value"])
    assert program == "flockd"
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert f"{words[-1]} is gone; {COMMANDS[command]}" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("key", KEYS)
def test_a_key_that_is_gone_is_refused_with_its_line_and_what_to_use(
    key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drone = (_CONFIG / "simulator.yaml").read_text(encoding="utf-8")
    *sections, name = key.split(".")
    inner: Any = yaml.safe_load(drone)
    for section in sections:
        inner = inner.get(section, {})
    assert name not in inner
    lines = drone.splitlines()
    if sections and f"{sections[0]}:" in lines:
        line = lines.index(f"{sections[0]}:") + 2
        lines.insert(line - 1, f"  {name}: 1")
    else:
        lines += [f"{sections[0]}:", f"  {name}: 1"] if sections else [f"{name}: 1"]
        line = len(lines)
    path = tmp_path / "drone.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert main(["config", "check", str(path)]) == 78
    assert f"{path}:{line}: {key}: is gone; {KEYS[key]}\n" in capsys.readouterr().err
