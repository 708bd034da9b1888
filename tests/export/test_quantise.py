"""Quantisation: the integers do what torch does, in another order of the latents, and the tables are the prior's."""

import copy

import numpy as np
import pytest
import torch

from tests.codec.eva_reference_decoder import synthesised
from tests.codec.signals import texture
from vibrocast.codec import Signal, eva
from vibrocast.codec.eva_image import EvaImage
from vibrocast.codec.mdct import built_in_tables
from vibrocast.export.checkpoint import ModelError
from vibrocast.export.eva import Eva, EvaShape, Gdn
from vibrocast.export.priors import ContextPrior, FactorisedPrior, Prior, probabilities
from vibrocast.export.quantise import centre_frequencies, ordered, quantise

SIGNALS: list[Signal] = [texture(6000, seed=seed)[:, 0] for seed in range(3)]


def random_model(shape: EvaShape) -> Eva:
    """Return a model whose GDN mixes channels, and whose latents are of unequal loudness."""
    torch.manual_seed(sum(shape.as_dict().values()))
    model = Eva(shape)
    with torch.no_grad():
        for layer in [*model.analysis, *model.synthesis]:
            if isinstance(layer, Gdn):
                layer.root_gamma.add_(0.3 * torch.rand_like(layer.root_gamma))
                layer.root_beta.mul_(0.5 + torch.rand_like(layer.root_beta))
        model.log2_step.add_(0.3 * torch.randn_like(model.log2_step) - 4)
    return model.eval()


def analysed(model: Eva) -> torch.Tensor:
    signal = torch.from_numpy(SIGNALS[0][:4096] / np.std(SIGNALS[0][:4096])).float()
    with torch.no_grad():
        return torch.as_tensor(model.analysis(signal[None, None]))


@pytest.mark.parametrize("shape", [EvaShape(8, 5, 3), EvaShape(16, 16, 1), EvaShape(3, 20, 2)])
def test_the_integers_do_what_torch_does(shape: EvaShape) -> None:
    """At 30 dB below the signal and less: int8 weights, of which the error of each is 1/254 of the greatest at most."""
    model = random_model(shape)
    image = quantise(model, ContextPrior(shape.latents), SIGNALS)
    assert image.network is not None and (image.latents, image.rates) == (shape.latents, shape.rates)
    unit = 2.0**image.fraction_bits
    integers = torch.round(analysed(model) * unit)
    with torch.no_grad():
        exact = model.synthesis(integers / unit)[0, 0].double().numpy()
    found = synthesised(image.network, integers[0].T.long().numpy(), 128 << 12) / (128 << 4)
    level = 64 * 2**13 / 256
    assert np.max(np.abs(exact)) * level < 32768, "no sample is clipped"
    assert 10 * np.log10(np.sum(exact**2) / np.sum((found - exact) ** 2)) > 30


def test_norms_of_latents_of_few_steps_are_exact() -> None:
    """As the paper's models have them at low rates: then norms weigh squares the most beside the constants."""
    model = random_model(EvaShape(8, 8, 1))
    with torch.no_grad():
        model.log2_step.fill_(-2)
        gdn = model.synthesis[0]
        assert isinstance(gdn, Gdn)
        gdn.root_gamma.mul_(3)
        latents = torch.round(analysed(model) * 4) / 4
        exact = model.synthesis(latents)[0, 0].double().numpy()
    assert 2 <= 4 * torch.max(torch.abs(latents)) <= 4
    image = quantise(model, FactorisedPrior(8), SIGNALS)
    assert image.network is not None
    integers = (latents[0].T * 2**image.fraction_bits).long().numpy()
    found = synthesised(image.network, integers, 128 << 12) / (128 << 4)
    assert 10 * np.log10(np.sum(exact**2) / np.sum((found - exact) ** 2)) > 30


def test_a_model_that_diverged_is_rejected() -> None:
    model = random_model(EvaShape(4, 4, 1))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(1e8)
    with pytest.raises(ModelError, match="NaN or infinity"):
        quantise(model, FactorisedPrior(4), SIGNALS)


def test_steps_are_those_of_the_model() -> None:
    model = random_model(EvaShape(4, 6, 4))
    factorised = quantise(model, FactorisedPrior(6), SIGNALS)
    contexts = quantise(model, ContextPrior(6), SIGNALS)
    wanted = torch.exp2(model.log2_step).detach().numpy()
    for rate, steps in enumerate(wanted):
        np.testing.assert_allclose(factorised.relative_steps(16 * rate), steps, rtol=0.01)
        # Dependent quantisation takes every second point of its own.
        np.testing.assert_allclose(contexts.relative_steps(16 * rate), steps / 2, rtol=0.01)


@pytest.mark.parametrize("prior", [ContextPrior(10), FactorisedPrior(10)], ids=lambda prior: str(prior.kind))
def test_another_order_of_the_latents_is_the_same_model(prior: Prior) -> None:
    model = random_model(EvaShape(6, 10, 2))
    before = copy.deepcopy(model.state_dict())
    changed, changed_prior = ordered(model, prior)
    latents, changed_latents = analysed(model), analysed(changed)
    frequencies = centre_frequencies(changed)
    assert np.all(np.diff(frequencies) >= 0)
    order = np.argsort(centre_frequencies(model), kind="stable")
    assert not np.array_equal(order, np.arange(10))
    torch.testing.assert_close(changed_latents, latents[:, order.tolist()])
    torch.testing.assert_close(changed.synthesis(changed_latents), model.synthesis(latents), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(changed.log2_step, model.log2_step[:, order.tolist()])
    if isinstance(prior, FactorisedPrior) and isinstance(changed_prior, FactorisedPrior):
        steps = np.ones(10)
        np.testing.assert_allclose(probabilities(changed_prior, steps, 5), probabilities(prior, steps, 5)[order])
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_tables_are_the_probabilities_of_the_prior() -> None:
    model, prior = random_model(EvaShape(4, 3, 2)), FactorisedPrior(3)
    image = quantise(model, prior, SIGNALS)
    assert isinstance(image.prior, np.ndarray)
    for rate in range(2):
        steps = torch.exp2(model.log2_step[rate]).detach().double().numpy()
        tables = image.prior[rate] / 65536
        expected = probabilities(prior, steps, 20)
        for channel in range(3):
            reached = 1.0
            for magnitude in range(6):
                stays = reached * (1 - tables[channel, magnitude])
                negative = stays * tables[channel, 15]
                reached -= stays
                if magnitude == 0:
                    assert stays == pytest.approx(expected[channel, 20], abs=1e-3)
                else:
                    both = expected[channel, 20 - magnitude] + expected[channel, 20 + magnitude]
                    assert stays == pytest.approx(both, abs=1e-3)
                    assert 0 <= negative <= stays


def test_tables_that_adapt_were_trained_on_the_signals() -> None:
    model, prior = random_model(EvaShape(4, 8, 3)), ContextPrior(8)
    image = quantise(model, prior, SIGNALS)
    untrained = built_in_tables()
    assert isinstance(image.prior, bytes) and image.prior != untrained
    assert quantise(model, prior, SIGNALS).pack() == image.pack()
    configuration = eva.configuration(64, [0], [16])
    latents = [analysed(model)[0, :, :64].double().numpy() / image.relative_steps(16)[:, None]]
    lengths = []
    for tables in (image.prior, untrained):
        payload = EvaImage(**{**vars(image), "prior": tables}).pack()
        lengths.append(len(eva.LatentEncoder(configuration, 1, payload, 0).encode(latents)))
    assert lengths[0] < lengths[1]


@pytest.mark.parametrize("signals", [[], [np.zeros(5000)], [np.zeros(0)]])
def test_calibration_without_a_signal_is_rejected(signals: list[Signal]) -> None:
    with pytest.raises(ModelError, match="no signal"):
        quantise(random_model(EvaShape(4, 4, 1)), ContextPrior(4), signals)
