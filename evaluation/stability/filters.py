"""Synthesis filters of linear prediction after quantisation, in three forms of their coefficients."""

from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np

from vibrocast.codec import slp
from vibrocast.errors import InputError
from vibrocast.evaluation.stability.maps import Map, Row
from vibrocast.evaluation.stability.signals import RATE_HZ, Signal
from vibrocast.evaluation.stability.trials import Measured, Trial, graded
from vibrocast.textures.generate import grating, stick_slip, wood

CODEC = "slp"
ORDERS = {f"order {order}": order for order in (2, 4, 8, 12, 16)}
BITS = (3, 4, 5, 6, 7, 8, 10, 12)
WINDOW_SAMPLES, HOP_SAMPLES = 512, 64
SECONDS = 2.0
FEW_PERCENT = 1.0


def predictors_of(reflections: Signal) -> Signal:
    """Return the predictors of reflection coefficients (n, order): the step-up recursion, inverse of the step-down."""
    errors = np.ones((len(reflections), 1))
    for last in reflections.T:
        longer = np.pad(errors, ((0, 0), (0, 1)))
        errors = longer + last[:, None] * longer[:, ::-1]
    return -errors[:, 1:]


def pole_radii(predictors: Signal) -> Signal:
    """Return the magnitude of the largest pole of each synthesis filter (n): stable below 1."""
    filters = np.concatenate([np.ones((len(predictors), 1)), -predictors], axis=1)
    return np.array([np.max(np.abs(np.roots(each)), initial=0.0) for each in filters])


def _through_reflections(predictors: Signal, bits: int) -> Signal:
    """Quantise reflection coefficients, as `slp` does with 5 bits."""
    largest = 2 ** (bits - 1) - 1
    codes = slp.reflection_codes(slp.reflections_of(predictors)[0], largest)
    return predictors_of(np.sin(codes * np.pi / (2 * (largest + 1))))


def _through_line_spectral_frequencies(predictors: Signal, bits: int) -> Signal:
    """Quantise the frequencies in equal steps from 0 to pi, at least one step apart to keep their order.

    Itakura, "Line spectrum representation of linear predictor coefficients of speech signals", 1975: the roots of A(z)
    +- z^-(order + 1) A(1 / z) lie on the unit circle and alternate. While they do, the filter is stable.
    """
    order = predictors.shape[1]
    steps = 2**bits
    if steps < order:
        raise InputError(f"{bits} bits cannot keep {order} line spectral frequencies apart; give more bits")
    fixed = ([1.0], [1.0, 0.0, -1.0]) if order % 2 else ([1.0, 1.0], [1.0, -1.0])  # roots at 1 and -1
    rising = np.arange(order)
    quantised = np.empty_like(predictors)
    for index, predictor in enumerate(predictors):
        errors = np.concatenate([[1.0], -predictor, [0.0]])
        halves = [
            np.roots(np.polydiv(errors + sign * errors[::-1], roots)[0])
            for sign, roots in zip((1, -1), fixed, strict=True)
        ]
        frequencies = np.sort(np.concatenate([np.sort(np.abs(np.angle(half)))[::2] for half in halves]))
        codes = np.floor(frequencies / np.pi * steps)
        codes = np.minimum(np.maximum.accumulate(codes - rising), steps - order) + rising
        turns = np.exp(1j * np.pi * (codes + 0.5) / steps)
        symmetric, antisymmetric = (
            np.convolve(np.real(np.poly(np.concatenate([half, np.conj(half)]))), roots)
            for half, roots in zip((turns[::2], turns[1::2]), fixed, strict=True)
        )
        quantised[index] = -(symmetric + antisymmetric)[1:-1] / 2
    return quantised


def _direct_form(predictors: Signal, bits: int) -> Signal:
    """Quantise in one fixed-point format, just wide enough for all. Filters may become unstable: only to compare."""
    step = 2 * float(np.max(np.abs(predictors), initial=1e-9)) / (2**bits - 1)
    return np.asarray(np.rint(predictors / step) * step, dtype=np.float64)


QUANTISERS: Mapping[str, Callable[[Signal, int], Signal]] = {
    "direct form": _direct_form,
    "line spectral frequencies": _through_line_spectral_frequencies,
    "reflection coefficients": _through_reflections,
}


def quantised_pole_radii(predictors: Signal, quantiser: str, bits: int) -> Signal:
    """Return the magnitude of each predictor's largest pole (n,), after quantisation with `bits` a coefficient.

    `predictors`: (n, order), stable. `quantiser`: one of QUANTISERS; `slp` uses reflection coefficients, because the
    direct form may become unstable. Raises InputError if the bits are too few for the order.
    """
    return pole_radii(QUANTISERS[quantiser](predictors, bits))


@lru_cache
def predictors(order: int) -> Signal:
    """Return the sparse predictors (frames, order) of generated textures as the codec fits them, poles mirrored in."""
    fitted = []
    for make in (wood, grating, stick_slip):
        samples = make(0, SECONDS, 50.0, RATE_HZ).samples[:, 0]
        samples = samples / np.abs(samples).max()
        found = slp.sparse_predictors(samples, WINDOW_SAMPLES, HOP_SAMPLES, order)
        fitted.append(slp.stabilised(found))
    return predictors_of(np.concatenate(fitted))


def measure(trial: Trial) -> Measured:
    """Quantise every predictor and grade the share of filters with a pole on or outside the unit circle."""
    radii = quantised_pole_radii(predictors(ORDERS[trial.case]), trial.method, int(trial.value))
    share, max_radius = float(np.mean(radii > 1 - 1e-9)), float(np.max(radii))
    figures = {"unstable_share": share, "max_pole_radius": max_radius, "predictors": len(radii)}
    effect = f"{100 * share:.1f} % of the filters unstable, largest pole {max_radius:.3f}" if share else ""
    return graded(share, 0.0, FEW_PERCENT / 100, figures, effect)


FILTERS = Map(
    "filter_stability",
    globals(),
    [
        Row(
            measure,
            lambda scope: map(Trial, QUANTISERS if scope.has(CODEC) else ()),
            tuple(ORDERS),
            BITS,
            case_step=4,
            value_step=4,
        )
    ],
)
