"""The codec `slp`: closed-loop sparse linear prediction, DCT of the residual; layout: docs/reference/bitstream.md.

Written from public descriptions of PVC-SLP (Hassen, Guelecyuez and Steinbach, "PVC-SLP: Perceptual Vibrotactile-Signal
Compression Based-on Sparse Linear Prediction", IEEE Trans. Multimedia, 2021). It is not the codec of the standard, and
reads none of its streams.

A predictor a (order) stands for x[n] ~ a[0] x[n-1] + a[1] x[n-2] + ...; its synthesis filter is 1 / A(z) with A(z) = 1
- a[0] z^-1 - a[1] z^-2 - ...
"""

import math
from collections.abc import Mapping
from copy import copy
from functools import lru_cache, partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vibrocast.codec.core import RATE_CONTROLLED, UNIT, CoreDecoder, CoreEncoder, PacketwiseEncoder
from vibrocast.codec.interface import (
    Codec,
    Framing,
    Model,
    Parameter,
    RateControl,
    RatePoints,
    Setting,
    Signal,
    SignalFormat,
    number,
    word,
)
from vibrocast.firmware.native_core import library

NAME = "slp"
IDENTIFIER = 3
FRAMES = (32, 64, 128)
MAX_ORDER = 16
MAX_PACKET_FRAMES = 4095
STEP_CODES = 21 * 8
QUANTISER_OFFSETS_OF_STEP_CODE = 2
"""Units of the quantiser offset in one step code."""
LEVELS = 32
"""Levels of `quality`, the coarsest 0."""
NEIGHBOURS, BIN = "neighbours", "bin"
ROUNDING, PLAIN_ROUNDING = 98 / 256, 0.5
"""By the first, a value nearly between two levels takes the lower one, which saves more than it spoils."""
_ANALYSIS_SAMPLES = 512
"""Samples to which a predictor is fitted: those up to the end of its frame."""
_CHUNK_FRAMES = 128
_KEPT_CHUNKS = 256
"""Chunks whose predictors are kept, about 16 MB of them."""
MAX_REFLECTION_CODE = 15
SPARSITY = 120.0
"""Weight gamma of the predictor's 1-norm relative to the residual's, in units of the RMS value."""
_ITERATIONS = 5
_MIN_RESIDUAL = 0.01
_MIN_COEFFICIENT = 0.01


def relative_step(quality: float) -> float:
    """Return the step of a level of `quality`, relative to the RMS value: five levels for each factor of two."""
    return math.exp2(2.2 - quality / 5)


def step_code(step: float) -> int:
    """Return the code of the step nearest `step` (relative to full scale), in 1/8 octaves."""
    return min(max(round(8 * math.log2(max(step, 1e-30) * UNIT / 8)), 0), STEP_CODES - 1)


class SlpEncoder(PacketwiseEncoder):
    """Encoder of `slp`; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(
        self,
        setting: Setting,
        signal_format: SignalFormat,
        framing: Framing,
        model: Model | None = None,
        rate_control: RateControl | None = None,
    ) -> None:
        """Make an encoder of a complete, checked setting; it takes no model.

        `rate_control`: chooses the quantiser offset of each packet, in 1/16 octave of the steps; None = no offsets.
        Raises CodecError for a channel count or packet length that the codec cannot have.
        """
        frame, order = int(word(setting, "frame")), int(number(setting, "order"))
        super().__init__(signal_format.channels, framing, frame, MAX_PACKET_FRAMES)
        self._frame, self._order = frame, order
        step = relative_step(number(setting, "quality"))
        step_codes = [step_code(step * rms) for rms in signal_format.rms]
        self._rate_control = rate_control
        # Loud signals have levels even at the largest steps. One offset more is silence, which fits any rate.
        self._silent = QUANTISER_OFFSETS_OF_STEP_CODE * (STEP_CODES - 1 - min(step_codes)) + 1
        self._quantiser_offsets = range(-QUANTISER_OFFSETS_OF_STEP_CODE * max(step_codes), self._silent + 1)
        self.configuration = bytes(
            (
                (setting["contexts"] == BIN) << 7 | FRAMES.index(frame) << 5 | order,
                self._packet_blocks & 255,
                self._packet_blocks >> 8,
                min(round(256 * number(setting, "shaping")), 255),
                round(8 * math.log2(signal_format.rate_hz)),
                *step_codes,
                *(RATE_CONTROLLED if rate_control else b""),
            )
        )
        self._core = CoreEncoder(
            NAME,
            self.configuration,
            self._channels,
            framing.refresh_packets,
            round(256 * number(setting, "rounding")),
        )
        self._before: Signal = np.zeros((_ANALYSIS_SAMPLES + order, self._channels))

    def _code_packets(self, signal: Signal) -> list[bytes]:
        count, frames = len(signal) // self.packet_samples, len(signal) // self._frame
        codes = np.stack([self._analysed(channel) for channel in np.concatenate([self._before, signal]).T], axis=1)
        units = np.rint(signal * UNIT).astype(np.int32).reshape(frames, self._frame, self._channels).swapaxes(1, 2)
        parts = zip(np.split(units, count), np.split(codes, count), np.split(signal, count), strict=True)
        packets = [self._packet_of(*part) for part in parts]
        self._before = np.concatenate([self._before, signal])[-len(self._before) :]
        return packets

    def _analysed(self, signal: Signal) -> NDArray[np.int8]:
        """Return one channel's reflection codes (frames, order); `signal`: the samples before, then the frames."""
        frames = (len(signal) - len(self._before)) // self._frame
        codes = np.zeros((frames, self._order), dtype=np.int8)
        for start in range(0, frames if self._order else 0, _CHUNK_FRAMES):
            stop = min(start + _CHUNK_FRAMES, frames)
            part = signal[start * self._frame : len(self._before) + stop * self._frame]
            codes[start:stop] = np.frombuffer(_predictors(part.tobytes(), self._frame, self._order), np.int8).reshape(
                -1, self._order
            )
        return codes

    def _packet_of(self, units: NDArray[np.int32], codes: NDArray[np.int8], samples: Signal) -> bytes:
        """Return a packet: samples in the core's unit by frame and channel, their predictors, the samples as given."""

        def code(encoder: CoreEncoder, quantiser_offset: int) -> bytes:
            stated = library().VC_SLP_SILENT if quantiser_offset == self._silent else quantiser_offset
            return encoder.packet(self.packet_samples, units, codes, stated)

        return self._chosen(samples, partial(code, self._core), lambda offset: code(copy(self._core), offset))


@lru_cache(maxsize=_KEPT_CHUNKS)
def _predictors(samples: bytes, frame: int, order: int) -> bytes:
    """Return the reflection codes, int8 (frames, order), of a chunk of float64 samples.

    They take longer than the rest of the encoder, and a search needs the same at each of its settings.
    """
    predictors = sparse_predictors(np.frombuffer(samples), _ANALYSIS_SAMPLES, frame, order)
    return reflection_codes(stabilised(predictors)).astype(np.int8).tobytes()


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


VARIANTS: Mapping[str, Setting] = {
    f"{NAME}-plain": {"rounding": PLAIN_ROUNDING},
    f"{NAME}-bin": {"contexts": BIN},
    f"{NAME}-plain-bin": {"rounding": PLAIN_ROUNDING, "contexts": BIN},
    f"{NAME}-shaping-0.5": {"shaping": 0.5},
    f"{NAME}-shaping-0.5-plain-bin": {"shaping": 0.5, "rounding": PLAIN_ROUNDING, "contexts": BIN},
    f"{NAME}-shaping-1": {"shaping": 1.0},
}
"""Other readings of the public descriptions: of the weight of the threshold, the rounding and the contexts."""

CODEC = Codec(
    name=NAME,
    identifier=IDENTIFIER,
    summary="closed-loop sparse linear prediction, DCT of the residual with perceptual steps, range coding",
    parameters={
        "quality": Parameter("quality level; 0 is the coarsest", 16, low=0, high=LEVELS - 1, whole=True),
        "frame": Parameter("samples per frame", "64", choices=tuple(map(str, FRAMES)), is_block=True),
        "order": Parameter("order of the predictor; 0 = no prediction", 8, low=0, high=MAX_ORDER, whole=True),
        "shaping": Parameter("how far the error follows the detection threshold; 0 = white error", 0.1, low=0, high=1),
        "contexts": Parameter(
            "what the bits of a magnitude depend on: its neighbours, or its bin alone",
            NEIGHBOURS,
            choices=(NEIGHBOURS, BIN),
        ),
        "rounding": Parameter(
            "part of a step added before rounding down; 0.5 = to the nearest level", ROUNDING, low=0, high=0.5
        ),
    },
    rate_point_sets={
        name: RatePoints(tuple({"quality": quality, **given} for quality in range(LEVELS)), is_variant=name != NAME)
        for name, given in {NAME: {}, **VARIANTS}.items()
    },
    make_encoder=SlpEncoder,
    make_decoder=lambda configuration, channels, tables: CoreDecoder(NAME, configuration, channels),
    controls_rate=True,
    forget=_predictors.cache_clear,
)
