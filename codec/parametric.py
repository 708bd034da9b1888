"""The codec `parametric`: band levels, their course over time and ridges; layout: docs/reference/bitstream.md."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.core import HOPS, UNIT, CoreDecoder, CoreEncoder, PacketwiseEncoder
from vibrocast.codec.interface import (
    Codec,
    CodecError,
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

NAME = "parametric"
IDENTIFIER = 11
BANDS = ("octave", "half octave", "third octave", "sixth octave")
"""Rough widths of bands: at least a bin, and 1, 1/2, 1/4 or 1/8 of the frequency at which the band begins."""
LEVEL_STEPS_DB = ("6", "3", "1.5", "0.75")
MAX_FRAME = 64
"""Blocks in a frame."""
MAX_HARMONICS = 8
MAX_PACKET_SAMPLES = 1 << 18
PITCHES = 512

_OCTAVES = 21
_MIN_AMPLITUDE = 64
"""Amplitude of level 1, in the core's unit."""
_HYSTERESIS = 0.75
"""Distance in steps from the level of the frame before at which a level changes; plain rounding has 1/2."""
_RIDGE_WINDOW = 1024
"""Samples that are searched for ridges: three turns of the slowest, 1/340 of a turn per sample."""
_MIN_TURN, _MAX_TURN = 3 / _RIDGE_WINDOW, 0.25
_LINE_EXCESS = 12.0
"""Least power of a spectral line over the median around it. Noise exceeds it in one bin of 4000: exp(-12 ln 2)."""
_SUBHARMONIC_WEIGHT = 0.84
"""Weight of each harmonic relative to the one before: D. J. Hermes, "Measurement of pitch by subharmonic summation",
1988."""
_MIN_FIT = 512
"""Samples to which the harmonics' levels are fitted, or as many as a frame has, if more."""
_RIDGE_SHARE = 0.25
"""Part of the signal's energy that ridges must hold to be coded."""
_BATCH = 64
"""Frames that are searched for ridges at a time, to limit memory."""


@cache
def analysis_matrix(hop: int) -> Signal:
    """Return the windowed forward MDCT (2 hop, hop): sqrt(2/N) w[n] cos(pi/N (n + 1/2 + N/2)(k + 1/2)), sine window w.

    Princen, Johnson and Bradley, "Subband/transform coding using filter bank designs based on time domain aliasing
    cancellation", 1987.
    """
    n = np.arange(2 * hop)[:, None]
    k = np.arange(hop)[None, :]
    window = np.sin(np.pi * (n + 0.5) / (2 * hop))
    matrix: Signal = np.sqrt(2 / hop) * window * np.cos(np.pi / hop * (n + 0.5 + hop / 2) * (k + 0.5))
    return matrix


def band_edges(hop: int, bands: str) -> NDArray[np.intp]:
    """Return the first bin of each band and, after the last one, the hop."""
    edges, spacing = [0], BANDS.index(bands)
    while edges[-1] < hop:
        following = edges[-1] + max(edges[-1] >> spacing, 1)
        edges.append(following if 2 * (hop - following) >= following >> spacing else hop)
    return np.array(edges)


def amplitudes(level_bits: int) -> Signal:
    """Return the amplitudes of the levels from 1 on, in the core's unit: float64 (levels,)."""
    codes = np.arange(_OCTAVES << level_bits) << (6 - level_bits)
    each: Signal = np.ldexp(_MIN_AMPLITUDE + codes % 64.0, codes // 64)
    return each


def turns() -> Signal:
    """Return the turns per sample of the pitch codes: float64 (PITCHES,)."""
    codes = np.arange(PITCHES)
    each: Signal = np.ldexp(1 + codes % 64 / 64, codes // 64 - 10)
    return each


@dataclass(frozen=True)
class Shape:
    """The structure of a description: see the parameters of CODEC. `frame`, `interval`: in blocks."""

    hop: int
    bands: str
    level_bits: int
    frame: int
    interval: int
    harmonics: int

    @property
    def frame_samples(self) -> int:
        """Samples of a frame."""
        return self.hop * self.frame

    def configuration(self, packet_frames: int) -> bytes:
        """Return the codec's bytes in the stream header."""
        head = HOPS.index(self.hop) | BANDS.index(self.bands) << 2 | self.level_bits << 4
        frame_exponent, interval_exponent = self.frame.bit_length() - 1, self.interval.bit_length() - 1
        return bytes(
            (head, self.harmonics | frame_exponent << 4, interval_exponent, *packet_frames.to_bytes(2, "little"))
        )


ENVELOPE = Shape(hop=32, bands="third octave", level_bits=3, frame=8, interval=1, harmonics=MAX_HARMONICS)
"""The description behind `envelope`: an amplitude every 11 ms at 2800 Hz."""


class ParametricEncoder(PacketwiseEncoder):
    """Encoder of `parametric`; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(
        self,
        setting: Setting,
        signal_format: SignalFormat,
        framing: Framing,
        model: Model | None = None,
        rate_control: RateControl | None = None,
    ) -> None:
        """Make an encoder of a complete, checked setting; it takes neither a model nor a rate control.

        Raises CodecError for an interval longer than a frame, an invalid channel count or packet length.
        """
        shape = Shape(
            hop=int(word(setting, "hop")),
            bands=word(setting, "bands"),
            level_bits=LEVEL_STEPS_DB.index(word(setting, "step_db")),
            frame=int(word(setting, "frame")),
            interval=int(word(setting, "interval")),
            harmonics=int(number(setting, "harmonics")),
        )
        if shape.interval > shape.frame:
            raise CodecError(
                f"interval={shape.interval} is longer than frame={shape.frame}; choose a shorter interval or a longer "
                "frame"
            )
        channels = signal_format.channels
        super().__init__(channels, framing, shape.frame_samples, MAX_PACKET_SAMPLES // shape.frame_samples)
        self._shape = shape
        self.delay_samples = shape.hop
        self.configuration = shape.configuration(self._packet_blocks)
        # Refreshes keep their distance in time if a frame is longer than the requested packets.
        refresh_packets = framing.refresh_packets * framing.packet_samples // self.packet_samples
        if framing.refresh_packets > 0:
            refresh_packets = max(refresh_packets, 1)
        self._core = CoreEncoder(NAME, self.configuration, channels, refresh_packets)
        self._analyses = [_Analysis(shape) for _ in range(channels)]

    def _code_packets(self, signal: Signal) -> list[bytes]:
        count = len(signal) // self.packet_samples
        described = [analysis.describe(channel) for analysis, channel in zip(self._analyses, signal.T, strict=True)]
        packets = np.split(np.stack(described, axis=1), count)
        return [self._core.packet(self.packet_samples, frames) for frames in packets]


class _Analysis:
    """Finds the description of one channel, frame after frame."""

    def __init__(self, shape: Shape) -> None:
        self._shape = shape
        self._segment = shape.frame_samples + shape.hop  # samples that a frame's blocks cover
        self._window = max(_RIDGE_WINDOW, self._segment)
        self._before: Signal = np.zeros(self._window)
        self._edges = band_edges(shape.hop, shape.bands)
        self._levels = np.log2(amplitudes(shape.level_bits) / UNIT)
        self._last = np.zeros(len(self._edges) - 1, dtype=np.int16)
        n = np.arange(2 * shape.hop)[:, None]
        k = np.arange(shape.hop)[None, :]
        # Cosine and sine transform together have the power of a tone at any phase (the MCLT of H. S. Malvar, "A
        # modulated complex lapped transform and its applications to audio processing", ICASSP 1999).
        cosines = analysis_matrix(shape.hop)
        angles = np.pi / shape.hop * (n + 0.5 + shape.hop / 2) * (k + 0.5)
        window = np.sqrt(2 / shape.hop) * np.sin(np.pi * (n + 0.5) / (2 * shape.hop))
        self._transforms = (cosines, window * np.sin(angles))

    def describe(self, signal: Signal) -> NDArray[np.int16]:
        """Return the frames of a signal of whole frames: pitch, levels over time, bands, harmonics."""
        shape = self._shape
        known = np.concatenate([self._before, signal])
        self._before = known[-self._window :]
        every = np.lib.stride_tricks.sliding_window_view(known, self._window)
        spans = every[shape.frame_samples :: shape.frame_samples]
        segments = spans[:, -self._segment :]
        pitches, harmonics, ridges = self._ridges(spans)
        times = self._times(self._powers(segments))
        gains = np.repeat(np.exp2(times / (1 << shape.level_bits)), shape.interval, axis=1)
        energy = np.mean(np.square(gains), axis=1)
        starts = self._edges[:-1]
        bands = np.add.reduceat(np.mean(self._powers(segments - ridges), axis=1), starts, axis=1)
        mean_squares = bands / np.diff(self._edges) / energy[:, None]
        return np.concatenate(
            [
                pitches[:, None],
                times,
                self._steady(_log2(np.sqrt(mean_squares))),
                self._nearest(_log2(harmonics / np.sqrt(energy)[:, None])),
            ],
            axis=1,
        ).astype(np.int16)

    def _powers(self, segments: Signal) -> Signal:
        """Return the mean square of both transforms (frames, blocks, bins); a segment is a hop, then a frame."""
        hop = self._shape.hop
        blocks = np.lib.stride_tricks.sliding_window_view(segments, 2 * hop, axis=1)[:, ::hop]
        cosines, sines = (np.square(blocks @ transform) for transform in self._transforms)
        powers: Signal = (cosines + sines) / 2
        return powers

    def _times(self, powers: Signal) -> NDArray[np.int16]:
        """Return the levels over time (frames, times): each interval's energy relative to the frame's mean."""
        frames, times = len(powers), self._shape.frame // self._shape.interval
        energies = np.mean(powers.sum(axis=2).reshape(frames, times, self._shape.interval), axis=2)
        relative = _log2(np.sqrt(energies)) - _log2(np.sqrt(np.mean(energies, axis=1)))[:, None]
        limit = _OCTAVES << self._shape.level_bits
        return np.clip(np.rint(relative * (1 << self._shape.level_bits)), -limit, limit).astype(np.int16)

    def _nearest(self, logarithms: Signal) -> NDArray[np.int16]:
        """Return the levels nearest to amplitudes relative to full scale, given as logarithms to base 2."""
        middles = (self._levels[1:] + self._levels[:-1]) / 2
        lowest = self._levels[0] - 0.5 / (1 << self._shape.level_bits)
        return np.where(logarithms < lowest, 0, 1 + np.searchsorted(middles, logarithms)).astype(np.int16)

    def _steady(self, logarithms: Signal) -> NDArray[np.int16]:
        """Return levels (frames, bands) that change only when the exact level is far enough away."""
        levels = self._nearest(logarithms)
        for frame, exact in zip(levels, logarithms, strict=True):
            near = np.abs(exact - self._levels[np.maximum(self._last, 1) - 1]) < _HYSTERESIS / (
                1 << self._shape.level_bits
            )
            frame[:] = np.where(near & (self._last > 0) & (frame > 0), self._last, frame)
            self._last = frame
        return levels

    def _ridges(self, spans: Signal) -> tuple[NDArray[np.int16], Signal, Signal]:
        """Return pitch codes (frames,), -1 = no ridges; the harmonics' amplitudes; the ridges in the segments."""
        harmonics = self._shape.harmonics
        pitches = np.full(len(spans), -1, dtype=np.int16)
        amplitudes = np.zeros((len(spans), harmonics))
        ridges = np.zeros((len(spans), self._segment))
        fitted_samples = max(self._segment, _MIN_FIT)
        for start in range(0, len(spans) if harmonics > 0 else 0, _BATCH):
            found = turns_of(spans[start : start + _BATCH], harmonics)
            for frame, turn in enumerate(found, start):
                if turn == 0:
                    continue
                span = spans[frame, -fitted_samples:]
                count = min(harmonics, math.ceil(0.5 / turn) - 1)
                angles = 2 * np.pi * turn * np.arange(1, count + 1) * np.arange(fitted_samples)[:, None]
                waves = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
                weights = np.linalg.lstsq(waves, span, rcond=None)[0]
                fitted = waves @ weights
                if np.sum(np.square(fitted)) >= _RIDGE_SHARE * np.sum(np.square(span)):
                    pitches[frame] = np.argmin(np.abs(np.log(turns() / turn)))
                    amplitudes[frame, :count] = np.hypot(weights[:count], weights[count:])
                    ridges[frame] = fitted[-self._segment :]
        return pitches, amplitudes, ridges


def envelope(signal: Signal) -> tuple[Signal, Signal]:
    """Return the sines that stand for a signal (n,) of full scale 1 by its finest description.

    Their amplitudes (m,), and their frequencies (m,) in turns per sample: the mean of the bands and harmonics, weighted
    by their power; one of each for every ENVELOPE.hop samples, the first one for sample 0.
    """
    shape = ENVELOPE
    padded = np.pad(signal, (0, -len(signal) % shape.frame_samples))
    edges = band_edges(shape.hop, shape.bands)
    times_end, bands_end = 1 + shape.frame // shape.interval, -shape.harmonics
    frames = _Analysis(shape).describe(padded)
    levels = np.concatenate([[0.0], amplitudes(shape.level_bits) / UNIT])
    # A block has the mean square of its samples in each bin, on average; a sine has half the square of its amplitude.
    powers = np.concatenate(
        [
            np.square(levels[frames[:, times_end:bands_end]]) * np.diff(edges) / shape.hop,
            np.square(levels[frames[:, bands_end:]]) / 2,
        ],
        axis=1,
    )
    harmonics = turns()[frames[:, :1]] * np.arange(1, shape.harmonics + 1)
    bands = np.broadcast_to((edges[1:] + edges[:-1]) / (4 * shape.hop), (len(frames), len(edges) - 1))
    sums = np.sum(powers, axis=1)
    means = np.sum(powers * np.concatenate([bands, harmonics], axis=1), axis=1) / np.maximum(sums, np.finfo(float).tiny)
    gains = np.exp2(frames[:, 1:times_end] / (1 << shape.level_bits))
    return (np.sqrt(2 * sums)[:, None] * gains).ravel(), np.repeat(means, gains.shape[1])


def turns_of(spans: Signal, harmonics: int) -> Signal:
    """Return the turns per sample of the ridges in each span (spans, samples): 0 if none rise above the noise.

    float64 (spans,). The pitch has the greatest weighted sum of harmonics (Hermes 1988). It is then refined by the
    peaks of those harmonics.
    """
    samples = spans.shape[1]
    padded = 4 * samples
    spectra = np.square(np.abs(np.fft.rfft(spans * np.hanning(samples + 1)[:-1], padded, axis=1)))
    reach = 64  # bins of the padded spectrum: eight main lobes of the window
    wide = np.pad(spectra, ((0, 0), (reach, reach)), "reflect")
    noise = np.median(np.lib.stride_tricks.sliding_window_view(wide, 2 * reach + 1, axis=1)[:, :, ::8], axis=2)
    lines = np.sqrt(np.where(spectra > _LINE_EXCESS * noise, spectra, 0))
    each, numbers = turns(), np.arange(1, harmonics + 1)
    bins = np.rint(each[:, None] * numbers * padded).astype(np.intp)
    weights = np.where(bins < lines.shape[1], _SUBHARMONIC_WEIGHT ** (numbers - 1), 0)
    scores = np.sum(lines[:, np.minimum(bins, lines.shape[1] - 1)] * weights, axis=2)
    scores[:, (each < _MIN_TURN) | (each > _MAX_TURN)] = 0
    best = np.argmax(scores, axis=1)
    found = [_refined(row, each[pitch], numbers) for row, pitch in zip(lines, best, strict=True)]
    return np.where(np.max(scores, axis=1) > 0, found, 0)


def _refined(lines: Signal, turn: float, numbers: NDArray[np.intp]) -> float:
    """Return the turns per sample whose multiples fit best to the lines within 1.5 % of the multiples of `turn`."""
    bins_per_turn = 2 * (len(lines) - 1)
    powers = products = 0.0
    for harmonic, middle in zip(numbers, numbers * turn * bins_per_turn, strict=True):
        first, last = math.ceil(0.985 * middle - 1), math.floor(1.015 * middle + 1)
        around = np.power(lines[first : last + 1], 4)
        if np.any(around):
            # A least-squares fit, weighted by power: if a turn is wrong by d, the peak of a harmonic is off by harmonic
            # * d.
            peak = first + np.sum(around * np.arange(len(around))) / np.sum(around)
            power = math.sqrt(np.max(around))
            powers += power * harmonic**2
            products += power * harmonic * peak
    return float(products / powers / bins_per_turn) if powers else turn


def _log2(values: Signal) -> Signal:
    """Return logarithms to base 2; for zero, one far below all levels."""
    return np.log2(np.maximum(values, 2.0**-60))


_POWERS = tuple(str(1 << exponent) for exponent in range(MAX_FRAME.bit_length()))


def _rate_point(bands: str, step_db: str, frame: int, interval: int, harmonics: int) -> Setting:
    return {
        "bands": bands,
        "step_db": step_db,
        "frame": str(frame),
        "interval": str(interval),
        "harmonics": harmonics,
    }


CODEC = Codec(
    name=NAME,
    identifier=IDENTIFIER,
    summary="band levels, their course over time and ridges, to synthesise a similar texture; keeps no waveform",
    parameters={
        "bands": Parameter("width of the bands of the spectral envelope", "half octave", choices=BANDS),
        "step_db": Parameter("step of all levels, in dB", "3", choices=LEVEL_STEPS_DB),
        "hop": Parameter("samples in a block", "64", choices=tuple(map(str, HOPS)), is_block=True),
        "frame": Parameter("blocks from one envelope to the next", "8", choices=_POWERS),
        "interval": Parameter("blocks for each level over time, at most a frame", "2", choices=_POWERS),
        "harmonics": Parameter(
            "harmonics of ridges; 0 = no ridges", MAX_HARMONICS, low=0, high=MAX_HARMONICS, whole=True
        ),
    },
    # From 35 bit/s to 400 bit/s at 2800 Hz, roughly.
    rate_point_sets={
        NAME: RatePoints(
            (
                _rate_point("octave", "6", 32, 32, 0),
                _rate_point("half octave", "6", 16, 8, 4),
                _rate_point("half octave", "3", 16, 4, 8),
                _rate_point("half octave", "3", 8, 2, 8),
                _rate_point("third octave", "3", 8, 1, 8),
            )
        )
    },
    make_encoder=ParametricEncoder,
    make_decoder=lambda configuration, channels, tables: CoreDecoder(NAME, configuration, channels),
    keeps_waveform=False,
)
