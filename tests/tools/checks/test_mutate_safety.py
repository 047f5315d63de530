"""The sample of mutants that CI tries: drawn by its seed, and failed by one survivor that nobody explained."""

from __future__ import annotations

from tools.checks.mutate_safety import EQUIVALENT, ROOT, SAFETY, mutants_of, report, sample

MUTANTS = list(mutants_of(ROOT / SAFETY / "half_planes.py"))
EXPLAINED = next(mutant for mutant in MUTANTS if mutant.name in EQUIVALENT)
OTHERS = [mutant for mutant in MUTANTS if mutant.name not in EQUIVALENT]


def test_a_seed_draws_the_same_mutants_again_and_another_seed_others() -> None:
    drawn = sample(MUTANTS, 20, "a")
    assert len({mutant.name for mutant in drawn}) == 20
    assert drawn == sample(MUTANTS, 20, "a")
    assert drawn != sample(MUTANTS, 20, "b")
    assert sample(MUTANTS, 10_000, "a") == MUTANTS


def test_a_survivor_fails_unless_it_is_known_to_mean_the_same() -> None:
    tried = [EXPLAINED, *OTHERS[:5]]
    assert report(tried, [EXPLAINED], whole=False) == 0
    assert report(tried, [EXPLAINED, OTHERS[0]], whole=False) == 1


def test_an_explanation_without_a_survivor_is_stale_only_where_all_mutants_of_its_name_were_tried() -> None:
    assert report(OTHERS[:5], [], whole=False) == 0
    assert report([EXPLAINED], [], whole=False) == 0  # another of the same name may survive
    assert report(OTHERS[:5], [], whole=True) == 1
