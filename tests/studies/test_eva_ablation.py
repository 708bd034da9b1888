"""The ablation of EVA's training: what each variant changes, and what it is compared with."""

import pytest

from studies.eva_ablation import LAMBDA, VARIANTS, Measured, Variant, configured, rows_of


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: f"{variant.ours}-{variant.name}")
def test_a_variant_changes_what_it_states(variant: Variant) -> None:
    found = configured(variant)
    stated = {"model": found.model, "training": found.training}
    values = {name: getattr(table, name) for table in stated.values() for name in table.__struct_fields__}
    for name, value in variant.changes.items():
        assert values[name] == value
    if not variant.changes:
        paper = ("random", "noise", 0.0, "static", 8e-3), ("lapped", "straight-through", 0.12, "adaptive", 2e-3)
        names = ("start", "rounding", "dead_zone", "cost", "learning_rate")
        assert tuple(values[name] for name in names) == paper[variant.ours]


def test_bits_are_compared_at_equal_quality_with_the_own_recipe() -> None:
    measured = [Measured(2.0 if variant.ours else 1.0, 0.1, 10.0, 16) for variant in VARIANTS]
    measured[1] = Measured(0.9, 0.1 + 0.1 / LAMBDA, 9.0, 15)  # as many bits fewer as its error costs
    rows = rows_of(measured)
    assert {row.recipe for row in rows} == {"the paper", "examples/eva.toml"}
    assert [row.more_bits_percent for row in rows] == pytest.approx([0.0] * len(rows))
    measured[-1] = Measured(2.1, 0.1, 10.0, 16)
    assert rows_of(measured)[-1].more_bits_percent == pytest.approx(5.0)
