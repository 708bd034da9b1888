"""Linear predictors for `slp`: sparse fits, and reflection coefficients, stable and quantised.

A predictor a (order) stands for x[n] ~ a[0] x[n-1] + a[1] x[n-2] + ...; its synthesis filter is 1 / A(z) with A(z) = 1
- a[0] z^-1 - a[1] z^-2 - ...
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vibrocast.codec.interface import Signal

MAX_REFLECTION_CODE = 15
SPARSITY = 120.0
"""Weight gamma of the predictor's 1-norm relative to the residual's, in units of the RMS value."""
_ITERATIONS = 5
_MIN_RESIDUAL = 0.01
_MIN_COEFFICIENT = 0.01


def sparse_predictors(signal: Signal, samples: int, hop: int, order: int) -> Signal:
    """Fit predictors a by min ||x - X a||_1 / s + gamma ||a||_1 to windows x of a signal (n,).

    X holds the `order` samples before each of x; s is the RMS value of x. The problem is that of Giacobello,
    Christensen, Murthi, Jensen and Moonen, "Sparse Linear Prediction and Its Applications to Speech Processing", IEEE
    Trans. Audio, Speech and Language Processing 20, 2012. Iteratively reweighted least squares solve it (Daubechies,
    DeVore, Fornasier and Gunturk, "Iteratively reweighted least squares minimization for sparse recovery", 2010). The
    weights 1 / |residual| and gamma / |a| of the last solution turn both norms into sums of squares.

    `samples`: length of a window, a multiple of `hop`, by which windows are apart. The first one begins at sample
    `hop + order`. Returns (windows, order).
    """
    holders, blocks = samples // hop, (len(signal) - hop - order) // hop
    windows = blocks - holders + 1
    # All windows that hold a block of `hop` samples share its products, and differ only in the weights.
    # Single precision suffices: it moves predictors by 0.001 at most, far less than a step of their quantiser.
    starts = hop * np.arange(1, blocks + 1)[:, None] + order - np.arange(order + 1)
    lagged = sliding_window_view(signal.astype(np.float32), hop)[starts]
    one, other = np.triu_indices(order + 1)
    products = np.swapaxes(lagged[:, one] * lagged[:, other], 1, 2)
    pair = np.zeros((order + 1, order + 1), dtype=np.intp)
    pair[one, other] = pair[other, one] = np.arange(len(one))
    energies = sliding_window_view(np.sum(products[:, :, 0], axis=1), holders)
    scale: Signal = np.sqrt(np.mean(energies, axis=1, keepdims=True, dtype=np.float64) / hop) + 1e-9
    predictors: Signal = np.zeros((windows, order))
    filters = np.zeros((blocks + holders - 1, order + 1), dtype=np.float32)
    filters_of_blocks = np.swapaxes(sliding_window_view(filters, holders, axis=0), 1, 2)
    weights = np.ones((blocks, holders, hop), dtype=np.float32)
    penalty = np.zeros((windows, order))
    diagonal = np.arange(order)
    for _ in range(_ITERATIONS):
        sums = weights @ products
        parts = [sums[k : k + windows, holders - 1 - k] for k in range(holders)]
        covariances: Signal = np.sum(parts, axis=0)[:, pair].astype(np.float64)
        normal = covariances[:, 1:, 1:]
        # This keeps the equations solvable in silence, and the poles of pure tones off the unit circle.
        regularisation = 1e-4 * np.trace(normal, axis1=1, axis2=2)[:, None] / order + 1e-12
        normal[:, diagonal, diagonal] += regularisation + penalty
        predictors = np.asarray(np.linalg.solve(normal, covariances[:, 1:, :1])[:, :, 0], dtype=np.float64)
        filters[holders - 1 : blocks] = np.concatenate([np.ones((windows, 1)), -predictors], axis=1) / scale
        weights = 1 / np.maximum(np.abs(filters_of_blocks @ lagged), _MIN_RESIDUAL)
        penalty = SPARSITY * scale**2 / (np.abs(predictors) + _MIN_COEFFICIENT)
    return predictors


def reflections_of(predictors: Signal) -> tuple[Signal, NDArray[np.bool_]]:
    """Return the reflection coefficients of predictors (n, order), and which predictors have no stable filter (n,).

    The step-down recursion (Markel and Gray, "Linear Prediction of Speech", 1976): the synthesis filter is stable if
    and only if every coefficient is below 1 in magnitude. The coefficients of an unstable filter are of no use.
    """
    order = predictors.shape[1]
    errors = np.concatenate([np.ones((len(predictors), 1)), -predictors], axis=1)
    reflections = np.zeros_like(predictors)
    unstable = np.zeros(len(predictors), dtype=bool)
    for m in range(order, 0, -1):
        last = errors[:, m]
        unstable |= ~(np.abs(last) < 1)
        last = np.clip(last, -0.9999, 0.9999)
        reflections[:, m - 1] = last
        errors = ((errors - last[:, None] * errors[:, ::-1]) / (1 - last**2)[:, None])[:, :m]
    return reflections, unstable


def stabilised(predictors: Signal) -> Signal:
    """Return the reflection coefficients of predictors (n, order), with poles outside the unit circle mirrored into it.

    Unlike the autocorrelation method, the 1-norm fit may be unstable. Mirroring a pole, to 1 / conj(p), keeps the shape
    of the magnitude response.
    """
    reflections, unstable = reflections_of(predictors)
    for index in np.flatnonzero(unstable):
        poles = np.roots(np.concatenate([[1.0], -predictors[index]]))
        outside = np.abs(poles) >= 1
        poles[outside] = 1 / np.conj(poles[outside])
        mirrored = -np.real(np.poly(poles))[1:]
        reflections[index] = reflections_of(mirrored[None, :])[0][0]
    return reflections


def reflection_codes(reflections: Signal, largest: int = MAX_REFLECTION_CODE) -> NDArray[np.int16]:
    """Quantise reflection coefficients: code * pi / (2 (largest + 1)) is the arcsine, and none reaches 1.

    Equal steps of the arcsine are finer near 1, where the spectrum is more sensitive (Gray and Markel, "Quantization
    and bit allocation in speech processing", IEEE Trans. Acoustics, Speech and Signal Processing 24, 1976).
    """
    codes = np.rint(np.arcsin(reflections) * 2 * (largest + 1) / np.pi)
    return np.clip(codes, -largest, largest).astype(np.int16)
