"""The speed table: the time of each method for a million samples, all coded as one signal near a fixed ratio."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean

import numpy as np

from vibrocast import codec, textures
from vibrocast.codec.timing import time_coding
from vibrocast.evaluation import trained
from vibrocast.evaluation.cells import Method, RatePoint
from vibrocast.evaluation.points import Failure, Point

RATIO = 10.0
"""Compression ratio against 16 bits per sample at which the EVA paper states its times."""
BITS_PER_SAMPLE = 16 / RATIO
RATES = (BITS_PER_SAMPLE, 3.0)
"""Bits per sample near which methods are timed: the paper's ratio, and a rate that nearly all codecs reach."""
SAMPLES = 1 << 17


@dataclass(frozen=True)
class Speed:
    """The speed of a method: processor seconds of one core for each million samples, without process start.

    `rate`: bits per sample that its setting comes nearest to. `runtime`: the decoder, of codec.RUNTIMES, where a model
    leaves the choice; "" for codecs without. `snr_db`: of this signal as that runtime decodes it.
    """

    codec: str
    rate: float
    runtime: str
    setting: str
    samples: int
    bits_per_sample: float
    snr_db: float | None
    encode_s_per_megasample: float
    decode_s_per_megasample: float


def measure(
    methods: Sequence[Method],
    points: Sequence[Point],
    recordings: Iterable[textures.Recording],
    repeats: int,
    progress: Callable[[float, str], None] = lambda part, details: None,
) -> list[Speed | Failure]:
    """Time each codec's method at the settings whose points lie nearest to each of RATES in the mean.

    A codec that raises costs its own speed only. `progress` is called with the part done, from 0 to 1, and the name of
    the method.
    """
    recording = one_signal(recordings, SAMPLES)
    if recording is None:
        return []
    found: list[Speed | Failure] = []
    for place, method in enumerate(methods, 1):
        bits: dict[str, list[float]] = {}
        for point in points:
            if point.codec == method.name:
                bits.setdefault(point.setting, []).append(point.bits_per_sample)
        means = {each: fmean(bits[method.text(each)]) for each in method.rate_points if method.text(each) in bits}
        for rate in RATES if means and isinstance(method.coder, str) else ():
            nearest = min(means, key=lambda rate_point: abs(math.log2(means[rate_point] / rate)))
            try:
                found += _speeds(method, nearest, rate, recording, repeats)
            except Exception as error:  # whatever one codec raises, the others' speeds are wanted
                found.append(Failure.of(error, recording.name, method.name, method.text(nearest)))
        progress(place / len(methods), method.name)
    return found


def one_signal(recordings: Iterable[textures.Recording], samples: int) -> textures.Recording | None:
    """Return the first channels of recordings of one rate, each with a peak of 1, one after another and repeated.

    None where all are silent.
    """
    parts: list[codec.Signal] = []
    rate_hz = None
    for recording in recordings:
        channel = recording.samples[:, :1]
        peak = np.abs(channel).max(initial=0.0)
        rate_hz = rate_hz or recording.rate_hz
        if peak > 0 and recording.rate_hz == rate_hz:
            parts.append(channel / peak)
        if sum(map(len, parts)) >= samples:
            break
    if not parts or rate_hz is None:
        return None
    return textures.Recording(np.resize(np.concatenate(parts), (samples, 1)), rate_hz, "full scale", "all traces")


def _speeds(
    method: Method, rate_point: RatePoint, rate: float, recording: textures.Recording, repeats: int
) -> list[Speed]:
    """Return the speeds of a codec at one setting, by each runtime that it has."""
    encode = partial(rate_point.encode, recording)
    file = encode()
    speeds = []
    for runtime in trained.runtimes(rate_point.model) if rate_point.model else ("",):
        decode = partial(rate_point.decode, runtime=runtime or None)
        speeds.append(
            Speed(
                method.name,
                rate,
                runtime,
                method.text(rate_point),
                recording.samples.size,
                8 * len(file) / recording.samples.size,
                codec.snr_db(recording.samples, decode(file)),
                *time_coding(encode, decode, recording.samples.size, repeats),
            )
        )
    return speeds
