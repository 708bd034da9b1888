"""The faults that `python -m tests.mutants` plants: each finds its place in the firmware as it is now."""

import pytest

from tests.mutants import MUTANTS, Mutant, mutated


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.effect)
def test_a_fault_can_be_planted(mutant: Mutant) -> None:
    assert mutated(mutant)
    assert mutant.suites()


def test_each_fault_has_an_effect_of_its_own() -> None:
    assert len({mutant.effect for mutant in MUTANTS}) == len(MUTANTS)
