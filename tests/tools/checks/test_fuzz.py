"""A small share of the fuzzer's inputs, the same each time; and that it notices what it is for."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.tools.checks import misbehaving
from tools.checks.fuzz import shares
from tools.checks.fuzzing.campaign import Bounds, randomness, run
from tools.checks.fuzzing.mutation import absurd, mutated_bytes, mutated_json
from tools.checks.fuzzing.table import TARGETS
from tools.checks.fuzzing.target import LONGEST_ERROR, assert_readable

INPUTS = {
    "configurations": 12,
    "manifests": 25,
    "recordings": 25,
    "datasets": 80,
    "images": 15,
    "campaigns": 15,
    "mavlink": 250,
    "status": 50,
    "commands": 300,
    "simulation": 300,
    "frames": 300,
    "ros": 150,
    "networks": 2,
    "gate": 150,
    "supervisor": 250,
}
"""Inputs for each target: about half a second of computing."""


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers near the largest overflow, which is what is tried
@pytest.mark.parametrize("name", TARGETS)
def test_nothing_that_comes_from_outside_brings_it_down(name: str, tmp_path: Path) -> None:
    check = TARGETS[name].prepare(tmp_path)
    for number in range(INPUTS[name]):
        try:
            check(randomness(0, name, number))
        except Exception as error:
            error.add_note(f"python -m tools.checks.fuzz --only {name} --seed 0 --first {number} --count 1")
            raise


def test_a_campaign_notices_errors_hangs_memory_and_a_process_that_dies() -> None:
    result = run(misbehaving.TARGET, misbehaving.SEED, 0, 6, Bounds(cpu_s=0.5, memory_bytes=1 << 28))
    assert {finding.inputs[0]: what.partition(" ")[0] for what, finding in result.findings.items()} == {
        misbehaving.ANOTHER_ERROR: "KeyError",
        misbehaving.SPINS: "HangError",
        misbehaving.SWALLOWS: "MemoryError",
        misbehaving.DIES: "the",
    }
    assert "the process ended with -9" in result.findings
    assert result.inputs == 6


def test_an_input_is_the_same_whatever_came_before_it() -> None:
    assert randomness(3, "gate", 5).random() == randomness(3, "gate", 5).random()
    assert randomness(3, "gate", 5).random() != randomness(3, "gate", 6).random()
    assert randomness(3, "gate", 5).random() != randomness(4, "gate", 5).random()


def test_mutations_leave_the_original_as_it_is_and_change_most_copies() -> None:
    original = {"a": [1, {"b": 2.0}], "c": "x"}
    copies = [mutated_json(randomness(0, "json", number), original) for number in range(100)]
    assert original == {"a": [1, {"b": 2.0}], "c": "x"}
    assert sum(copy != original for copy in copies) > 90
    changed = [mutated_bytes(randomness(0, "bytes", number), bytes(range(64))) for number in range(100)]
    assert sum(data != bytes(range(64)) for data in changed) > 80
    kinds = {type(absurd(randomness(0, "absurd", number))) for number in range(200)}
    assert kinds == {int, float, str, bool, type(None), list, dict}


def test_every_target_gets_its_share() -> None:
    given = shares(list(TARGETS), 1_000_000)
    assert given.keys() == TARGETS.keys() == INPUTS.keys()
    assert math.isclose(sum(given.values()), 1_000_000, rel_tol=1e-3)
    assert min(shares(list(TARGETS), 1).values()) == 1


@pytest.mark.parametrize("text", ["", "x" * (LONGEST_ERROR + 1)])
def test_an_error_that_nobody_reads_is_none(text: str) -> None:
    with pytest.raises(AssertionError):
        assert_readable(text)
