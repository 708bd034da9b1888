"""The ablation of EVA's training: what each variant changes, and what it is compared with."""

import pytest
import torch

from studies.eva_ablation import CONTEXTS, LAMBDA, VARIANTS, ContextPrior, Measured, Variant, configured, rows_of


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: f"{variant.ours}-{variant.name}")
def test_a_variant_changes_what_it_states(variant: Variant) -> None:
    found = configured(variant)
    stated = {"model": found.model, "training": found.training}
    values = {name: getattr(table, name) for table in stated.values() for name in table.__struct_fields__}
    for name, value in variant.changes.items():
        assert values[name] == ("adaptive" if value == CONTEXTS else value)
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


def test_bits_by_contexts_are_probabilities_that_know_the_past_alone() -> None:
    torch.manual_seed(0)
    values = torch.arange(-300.0, 301.0).expand(1, 3, -1)
    prior = ContextPrior(6)
    contexts = torch.randint(-3, 4, (1, 6, 40)).float()
    with torch.no_grad():
        bits = ContextPrior(3).bits(values, torch.zeros_like(values))
        before = prior.scales(contexts)
        contexts[0, 3, 20] = 50
        changed = torch.any(prior.scales(contexts) != before, dim=0)
    assert torch.all(torch.abs(torch.exp2(-bits).sum(dim=2) - 1) < 0.01)
    assert not changed[:4, :21].any()
    assert changed[4:, 20].all()
    assert changed[1:, 21].all()
