"""Synthesis filters of linear prediction after quantisation: which forms of their coefficients stay stable."""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from codec import slp
from evaluation.stability import pictures
from evaluation.stability.maps import Map, Scope
from evaluation.stability.signals import RATE_HZ, Signal
from evaluation.stability.trials import Cell, Measured, Outcome, Trial
from textures.generate import grating, stick_slip, wood

CODEC = "slp"
ORDERS = (2, 4, 8, 12, 16)
BITS = (3, 4, 5, 6, 7, 8, 10, 12)
WINDOW_SAMPLES, HOP_SAMPLES = 512, 64
SECONDS = 2.0
FEW = 0.01


@lru_cache
def predictors(order: int) -> Signal:
    """Return the sparse predictors (frames, order) of generated textures as the codec fits them, poles mirrored in."""
    fitted = []
    for make in (wood, grating, stick_slip):
        samples = make(0, SECONDS, 50.0, RATE_HZ).samples[:, 0]
        samples = samples / np.abs(samples).max()
        windows = np.lib.stride_tricks.sliding_window_view(samples, WINDOW_SAMPLES + order)[::HOP_SAMPLES]
        rows = np.stack([windows[:, order - lag : order - lag + WINDOW_SAMPLES] for lag in range(1, order + 1)], axis=2)
        fitted.append(slp.stabilised(slp.sparse_predictors(rows, windows[:, order:])))
    return np.array([from_reflections(each) for each in np.concatenate(fitted)])


def from_reflections(reflections: Signal) -> Signal:
    """Return the predictor (order,) of reflection coefficients (order,): the step-up recursion."""
    errors = np.ones(1)
    for reflection in reflections:
        padded = np.append(errors, 0.0)
        errors = padded + reflection * padded[::-1]
    return -errors[1:]


def line_spectral_frequencies(predictor: Signal) -> Signal:
    """Return the line spectral frequencies (order,), in rad, rising: angles of the roots of A(z) +- z^-(p+1) A(1/z).

    F. Itakura, "Line spectrum representation of linear predictive coefficients of speech signals", 1975.
    """
    errors = np.concatenate([[1.0], -predictor, [0.0]])
    angles = [np.angle(np.roots(errors + sign * errors[::-1])) for sign in (1, -1)]
    found = np.sort(np.concatenate(angles))
    return found[(found > 1e-6) & (found < np.pi - 1e-6)]


def from_line_spectral_frequencies(frequencies: Signal) -> Signal:
    """Return the predictor (order,) of line spectral frequencies (order,), in rad, even order."""
    both = []
    for first, fixed in ((0, [1.0, 1.0]), (1, [1.0, -1.0])):
        polynomial = np.array(fixed)
        for frequency in frequencies[first::2]:
            polynomial = np.convolve(polynomial, [1.0, -2 * np.cos(frequency), 1.0])
        both.append(polynomial)
    return -np.asarray(both[0] + both[1])[1:-1] / 2


def quantised_directly(predictor: Signal, bits: int, largest: Signal) -> Signal:
    """Quantise the predictor itself, uniformly between the largest values that occur."""
    step = 2 * largest / 2**bits
    return np.asarray(np.rint(predictor / step) * step)


def quantised_reflections(predictor: Signal, bits: int, largest: Signal) -> Signal:
    """Quantise the arcsine of the reflection coefficients, uniformly, as the codec does: all stay below 1."""
    found = slp.reflections(predictor[None, :])[0][0]
    half = 2 ** (bits - 1)
    codes = np.clip(np.rint(np.arcsin(found) * half / (np.pi / 2)), -half + 1, half - 1)
    return from_reflections(np.sin(codes * np.pi / 2 / half))


def quantised_frequencies(predictor: Signal, bits: int, largest: Signal) -> Signal:
    """Quantise the line spectral frequencies, uniformly; two that fall together are not moved apart."""
    step = np.pi / 2**bits
    return from_line_spectral_frequencies((np.floor(line_spectral_frequencies(predictor) / step) + 0.5) * step)


FORMS: dict[str, Callable[[Signal, int, Signal], Signal]] = {
    "direct form": quantised_directly,
    "line spectral frequencies": quantised_frequencies,
    "reflection coefficients": quantised_reflections,
}


def measure(form: str, order: int, bits: int) -> Measured:
    """Quantise every predictor; judge by the share whose synthesis filter has a pole on or outside the unit circle."""
    exact = predictors(order)
    largest = np.abs(exact).max(axis=0)
    radii = [
        np.abs(np.roots(np.concatenate([[1.0], -FORMS[form](predictor, bits, largest)]))).max(initial=0.0)
        for predictor in exact
    ]
    share, largest_radius = float(np.mean(np.array(radii) > 1 - 1e-9)), float(max(radii))
    figures = {"unstable_share": share, "largest_pole_radius": largest_radius, "predictors": len(radii)}
    if share == 0:
        return Measured(Outcome.HOLDS, figures)
    effect = f"{100 * share:.1f} % of the filters unstable, largest pole {largest_radius:.3f}"
    return Measured(Outcome.DEGRADED if share <= FEW else Outcome.FAILS, figures, effect)


def _trials(scope: Scope) -> list[Trial]:
    if CODEC not in scope.codecs:
        return []
    step = 4 if scope.quick else 1
    return [
        Trial(FILTERS.name, form, f"order {order}", "", float(bits), partial(measure, form, order, bits))
        for form in FORMS
        for order in ORDERS[::step]
        for bits in BITS[::step]
    ]


def _draw(path: Path, cells: Sequence[Cell]) -> None:
    panels = []
    for form in FORMS:
        curves = []
        for case in dict.fromkeys(cell.case for cell in cells):
            own = [cell for cell in cells if (cell.method, cell.case) == (form, case)]
            shares = [100 * cell.figure("unstable_share") for cell in own]
            failed = [cell.outcome is Outcome.FAILS for cell in own]
            curves.append(pictures.Curve(case, [cell.value or 0.0 for cell in own], shares, failed))
        panels.append(pictures.Panel(f"{form}: unstable, %", "bits a coefficient", "", curves, least_span=10))
    pictures.curves(path, panels, across=3)


FILTERS = Map(
    "filter_stability",
    "Synthesis filters of linear prediction",
    f"Sparse predictors of generated wood, grating and stick-slip, fitted to {WINDOW_SAMPLES} samples as the codec "
    f"{CODEC} does, quantised in three forms: share of synthesis filters with a pole on or outside the unit circle. "
    f"Holds without any, fails above {100 * FEW:g} %.",
    "bits",
    _trials,
    _draw,
)
