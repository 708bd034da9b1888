"""Synthesis filters of linear prediction after quantisation, in three forms of their coefficients."""

from functools import lru_cache, partial

import numpy as np

from vibrocast.codec import linear_prediction
from vibrocast.evaluation.stability.maps import Group, Map, Place, Rule, Scope, figure, with_methods
from vibrocast.evaluation.stability.signals import RATE_HZ, Signal
from vibrocast.evaluation.stability.trials import Measured, Trial, graded
from vibrocast.textures.generate import grating, stick_slip, wood

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
        found = linear_prediction.sparse_predictors(samples, WINDOW_SAMPLES, HOP_SAMPLES, order)
        fitted.append(linear_prediction.stabilised(found))
    return linear_prediction.predictors_of(np.concatenate(fitted))


def measure(form: str, order: int, bits: int) -> Measured:
    """Quantise every predictor and grade the share of filters with a pole on or outside the unit circle."""
    radii = linear_prediction.quantised_pole_radii(predictors(order), form, bits)
    share, max_radius = float(np.mean(radii > 1 - 1e-9)), float(np.max(radii))
    figures = {"unstable_share": share, "max_pole_radius": max_radius, "predictors": len(radii)}
    effect = f"{100 * share:.1f} % of the filters unstable, largest pole {max_radius:.3f}" if share else ""
    return graded(share, 0.0, FEW, figures, effect)


def _trials(scope: Scope) -> list[Trial]:
    return [
        Trial(form, f"order {order}", partial(measure, form, order, bits), value=float(bits))
        for form in (linear_prediction.QUANTISERS if scope.has(CODEC) else ())
        for order in scope.some(ORDERS, 4)
        for bits in scope.some(BITS, 4)
    ]


FILTERS = Map(
    name="filter_stability",
    group=Group.SETTINGS,
    title="Quantised filters",
    tried=f"Predictors of generated textures, fitted as `{CODEC}` does, are quantised in three forms.",
    rule=Rule("filters with a pole on or outside the unit circle", "none", f"more than {100 * FEW:g} %"),
    conditions=_trials,
    message=lambda cells: f"Quantised filters stay stable {with_methods(cells, 'form')}",
    place=lambda cell: Place(f"{cell.method}, {cell.case}", cell.value or 0.0),
    caption="bits for each coefficient; unstable filters in %",
    label=figure("unstable_share", factor=100),
    value_name="bits",
    varied="{} bits",
)
