"""Quantisation: the integers do what torch does, and the probabilities are the prior's."""

import numpy as np
import pytest
import torch

from tests.codec.eva_reference_decoder import synthesised
from tests.codec.signals import texture
from vibrocast.codec import Signal
from vibrocast.export.eva import Eva, EvaShape, Gdn
from vibrocast.export.priors import FactorisedPrior, probabilities
from vibrocast.export.quantise import quantise
from vibrocast.models import ModelError

SIGNALS: list[Signal] = [texture(6000, seed=seed)[:, 0] for seed in range(3)]


def random_model(shape: EvaShape, steps: float = 16.0) -> Eva:
    """Return a model whose GDN mixes channels, and whose latents are of unequal loudness, around `steps` steps."""
    torch.manual_seed(shape.width + shape.latents)
    model = Eva(shape)
    with torch.no_grad():
        for layer in [*model.analysis, *model.synthesis]:
            if isinstance(layer, Gdn):
                layer.root_gamma.add_(0.3 * torch.rand_like(layer.root_gamma))
                layer.root_beta.mul_(0.5 + torch.rand_like(layer.root_beta))
        encoding, decoding = model.analysis[5], model.synthesis[0]
        assert isinstance(encoding, Gdn) and isinstance(decoding, Gdn)
        louder = steps * torch.exp2(0.3 * torch.randn(shape.latents))
        encoding.root_beta.div_(louder)
        encoding.root_gamma.div_(louder[:, None])
        decoding.root_beta.div_(louder)
        decoding.root_gamma.div_(louder[:, None] * louder)
    return model.eval()


def analysed(model: Eva) -> torch.Tensor:
    signal = torch.from_numpy(SIGNALS[0][:4096] / np.std(SIGNALS[0][:4096])).float()
    with torch.no_grad():
        return torch.as_tensor(model.analysis(signal[None, None]))


@pytest.mark.parametrize("shape", [EvaShape(8, 5), EvaShape(16, 16), EvaShape(3, 20)])
def test_the_integers_do_what_torch_does(shape: EvaShape) -> None:
    """At 30 dB below the signal and less: each int8 weight is off by 1/254 of the greatest at most."""
    model = random_model(shape)
    image = quantise(model, FactorisedPrior(shape.latents), SIGNALS)
    assert image.network is not None and image.latents == shape.latents
    unit = torch.exp2(torch.from_numpy(image.fraction_bits.astype(np.float32)))[:, None]
    integers = torch.round(analysed(model) * unit)
    with torch.no_grad():
        exact = model.synthesis(integers / unit)[0, 0].double().numpy()
    found = synthesised(image.network, integers[0].T.long().numpy(), 128 << 12) / (128 << 4)
    level = 64 * 2**13 / 256
    assert np.max(np.abs(exact)) * level < 32768, "no sample is clipped"
    assert 10 * np.log10(np.sum(exact**2) / np.sum((found - exact) ** 2)) > 30


def test_norms_of_latents_of_few_steps_are_exact() -> None:
    """As in the paper's models at low rates: squares then weigh most in norms, relative to the constants."""
    model = random_model(EvaShape(8, 8), steps=4.0)
    with torch.no_grad():
        gdn = model.synthesis[0]
        assert isinstance(gdn, Gdn)
        gdn.root_gamma.mul_(3)
        latents = torch.round(analysed(model))
        exact = model.synthesis(latents)[0, 0].double().numpy()
    assert 2 <= torch.max(torch.abs(latents)) <= 4
    image = quantise(model, FactorisedPrior(8), SIGNALS)
    assert image.network is not None
    integers = latents[0].T.long().numpy() << image.fraction_bits.astype(int)
    found = synthesised(image.network, integers, 128 << 12) / (128 << 4)
    assert 10 * np.log10(np.sum(exact**2) / np.sum((found - exact) ** 2)) > 30


def test_a_model_that_diverged_is_rejected() -> None:
    model = random_model(EvaShape(4, 4))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(1e30)
    with pytest.raises(ModelError, match="NaN or infinity"):
        quantise(model, FactorisedPrior(4), SIGNALS)


def test_probabilities_are_those_of_the_prior() -> None:
    prior = FactorisedPrior(3)
    tables = quantise(random_model(EvaShape(4, 3)), prior, SIGNALS).probabilities / 65536
    expected = probabilities(prior, 20)
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


@pytest.mark.parametrize("signals", [[], [np.zeros(5000)], [np.zeros(0)]])
def test_calibration_without_a_signal_is_rejected(signals: list[Signal]) -> None:
    with pytest.raises(ModelError, match="no signal"):
        quantise(random_model(EvaShape(4, 4)), FactorisedPrior(4), signals)
