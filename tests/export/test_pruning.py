"""Pruning: a model without its dead latents codes as before, and one that is all dead is rejected."""

import numpy as np
import pytest
import torch

from tests.export import tiny
from tests.export.test_quantise import SIGNALS, random_model
from vibrocast.codec.graphs import LATENTS, SIGNAL, Transform
from vibrocast.export.eva import Eva, EvaShape, Gdn
from vibrocast.export.graphs import graphs_of, padded_noise
from vibrocast.export.package import make
from vibrocast.export.priors import FactorisedPrior, probabilities
from vibrocast.export.pruning import living_latents, pruned
from vibrocast.models import ModelError


def model_with_dead(dead: list[int]) -> Eva:
    """Return a model of 6 latents, of which these are a thousandth of a step."""
    model = random_model(EvaShape(8, 6))
    last = model.analysis[5]
    assert isinstance(last, Gdn)
    with torch.no_grad():
        last.root_beta[dead] *= 1e4
        last.root_gamma[dead] *= 1e4
    return model


def test_a_pruned_model_codes_as_before() -> None:
    model, prior = model_with_dead([0, 4]), FactorisedPrior(6)
    living = living_latents(model, 0.0, SIGNALS)
    np.testing.assert_array_equal(living, [1, 2, 3, 5])
    smaller, smaller_prior = pruned(model, prior, living, 0.0)
    assert smaller.shape == EvaShape(8, 4)
    signal = torch.from_numpy(padded_noise(3000))
    with torch.no_grad():
        latents, fewer = model.analysis(signal), smaller.analysis(signal)
        assert torch.equal(latents[:, living], fewer), "the selection is exact"
        decoded, as_before = smaller.synthesis(torch.round(fewer)), model.synthesis(torch.round(latents))
    np.testing.assert_allclose(decoded, as_before, atol=1e-4 * float(as_before.abs().max()))
    np.testing.assert_array_equal(probabilities(smaller_prior, 15), probabilities(prior, 15)[living])


def test_the_dead_zone_of_a_training_is_in_the_graph() -> None:
    """Its bin of zero ends at 0.5 + 0.12, and a great latent is still the same level."""
    model = model_with_dead([0, 4])
    living = living_latents(model, 0.12, SIGNALS)
    plain, wider = (pruned(model, FactorisedPrior(6), living, dead_zone)[0] for dead_zone in (0.0, 0.12))
    signal = padded_noise(3000) / np.float32(4)
    before, after = (Transform(graphs_of(each, [64]).analysis, SIGNAL, LATENTS)(signal) for each in (plain, wider))
    np.testing.assert_array_equal(np.rint(after) == 0, np.abs(before) < 0.62)
    assert np.any(np.abs(before) > 2) and np.max(np.abs(after - before)) < 0.16


def test_a_model_without_a_living_latent_is_rejected() -> None:
    with pytest.raises(ModelError, match="zero for every signal"):
        living_latents(model_with_dead(list(range(6))), 0.0, SIGNALS)


def test_a_package_holds_only_living_latents() -> None:
    checkpoint = tiny.checkpoint()
    assert isinstance(checkpoint.model, Eva)
    last = checkpoint.model.analysis[5]
    assert isinstance(last, Gdn)
    with torch.no_grad():
        last.root_beta[3] *= 1e4
    package = make(checkpoint, "tiny", "1", "core", SIGNALS)
    assert 3 not in package.living and len(package.living) == 15
