"""Quantisers of predictors: those of reflection coefficients and of line spectral frequencies keep a filter stable."""

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.codec.signals import texture
from vibrocast.codec import Signal, slp
from vibrocast.errors import InputError
from vibrocast.evaluation.stability import filters


def frames_of_texture(order: int) -> Signal:
    """Predictors of a narrow-band texture, whose poles lie near the unit circle, as those of tonal recordings do."""
    narrow = lfilter(
        [1.0], np.poly([0.97 * np.exp(1j * x) for x in (0.3, -0.3, 0.45, -0.45)]).real, texture(8000)[:, 0]
    )
    fitted = slp.sparse_predictors(narrow / np.max(np.abs(narrow)), 512, 256, order)
    return filters.predictors_of(slp.stabilised(fitted))


@pytest.mark.parametrize("order", [4, 8, 13, 16])
@pytest.mark.parametrize("bits", [4, 5, 6, 8])
def test_reflection_and_line_spectral_quantisers_keep_the_filter_stable(order: int, bits: int) -> None:
    for quantiser in ("reflection coefficients", "line spectral frequencies"):
        radii = filters.quantised_pole_radii(frames_of_texture(order), quantiser, bits)
        assert np.max(radii) < 1


@pytest.mark.parametrize("order", [2, 5, 8])
def test_fine_quantisers_change_little_and_too_few_bits_are_rejected(order: int) -> None:
    predictors = frames_of_texture(order)
    for quantised in filters.QUANTISERS.values():
        np.testing.assert_allclose(quantised(predictors, 15), predictors, atol=0.05)
    with pytest.raises(InputError, match="apart"):
        filters.quantised_pole_radii(frames_of_texture(8), "line spectral frequencies", 2)


def test_a_direct_form_quantiser_makes_filters_unstable_and_their_output_grow() -> None:
    """The reason for reflection coefficients: same texture and bits, with the coefficients themselves quantised."""
    predictors = frames_of_texture(8)
    radii = filters.quantised_pole_radii(predictors, "direct form", 5)
    assert np.max(filters.pole_radii(predictors)) < 1
    assert np.max(radii) > 1.01
    worst = predictors[[int(np.argmax(radii))]]
    impulse = np.eye(1, 2800)[0]
    output = {
        name: lfilter([1.0], np.concatenate([[1.0], -filters.QUANTISERS[name](worst, 5)[0]]), impulse)
        for name in ("direct form", "reflection coefficients")
    }
    assert np.max(np.abs(output["direct form"][-500:])) > 100 * np.max(np.abs(output["direct form"][:500]))
    assert np.max(np.abs(output["reflection coefficients"][-500:])) < 1
