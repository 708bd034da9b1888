"""Signals that trained models may not know: of other kinds, quieter in parts, far from the stated level."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from scipy.signal import butter, sosfilt

from vibrocast import codec
from vibrocast.codec import CODECS, Setting, Signal
from vibrocast.codec.stream import Stream
from vibrocast.evaluation.bd_rate import fewest_bits
from vibrocast.evaluation.cells import RatePoint
from vibrocast.evaluation.stability import maps, signals
from vibrocast.evaluation.stability.maps import Map, Row, Scope, at_level
from vibrocast.evaluation.stability.signals import FAILED_SNR_DB, FAR_LOUDER_DB, RATE_HZ, SECONDS, encoded, texture
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, graded
from vibrocast.evaluation.trained import runtimes
from vibrocast.textures.generate import grating, ridges, rough, stick_slip, taps, wood

OWN = "mdct"
"""The codec for comparison: it has no learned transform, and its tables adapt to any signal."""
WANTED_SNR_DB = 10.0
HELD_RATIO, FAILED_RATIO = 1.25, 2.0
QUIETER_DB = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
OFF_LEVEL_DB = (-60.0, -48.0, -36.0, -24.0, -12.0, -6.0, 0.0, 6.0, 12.0, 24.0, 36.0)
LOST_DB = 3.0
_CLICKS = 12


def _noise() -> Signal:
    return np.random.default_rng(0).normal(size=signals.time_s().shape)


def _below(limit_hz: float) -> Signal:
    return np.asarray(sosfilt(butter(6, limit_hz, fs=RATE_HZ, output="sos"), _noise(), axis=0))


def _clicks(samples: Signal) -> Signal:
    """A texture with single samples 30 dB above its RMS value."""
    places = np.random.default_rng(0).choice(len(samples), _CLICKS, replace=False)
    with_clicks = samples.copy()
    with_clicks[places] += 10**1.5 * np.sqrt(np.mean(samples**2))
    return with_clicks


SIGNALS: dict[str, Callable[[], Signal]] = {
    "wood": lambda: wood(3, SECONDS).samples,
    "wood at half the speed": lambda: wood(3, SECONDS, 25.0).samples,
    "wood at twice the speed": lambda: wood(3, SECONDS, 100.0).samples,
    "wood, inverted": lambda: -wood(3, SECONDS).samples,
    "wood with clicks": lambda: _clicks(wood(3, SECONDS).samples),
    "sandpaper": lambda: rough(3, SECONDS).samples,
    "leather": lambda: stick_slip(3, SECONDS).samples,
    "ridges": lambda: ridges(3, SECONDS).samples,
    "grating": lambda: grating(3, SECONDS).samples,
    "taps": lambda: taps(3, SECONDS).samples,
    "sine of 60 Hz": partial(signals.sine, 60.0),
    "sine of 250 Hz": partial(signals.sine, 250.0),
    "sine of 1000 Hz": partial(signals.sine, 1000.0),
    "white noise": _noise,
    "noise below 100 Hz": partial(_below, 100.0),
    "noise below 400 Hz": partial(_below, 400.0),
}


def bits_to_reach(rate_point_set: Sequence[RatePoint], samples: Signal, snr_db: float) -> float:
    """Return the bits per sample at which a set of rate points reaches an SNR, infinity where it does not. Raises
    CodecError.
    """
    curve = []
    for rate_point in rate_point_set:
        heard, stream = signals.decoded(samples, RATE_HZ, rate_point)
        reached_db = codec.snr_db(samples, heard)
        curve.append((8 * stream.size_bytes / samples.size, math.inf if reached_db is None else reached_db))
    return fewest_bits(curve, snr_db)


def signal(name: str) -> Signal:
    """Return one of SIGNALS without its mean, with a peak of 1."""
    samples = SIGNALS[name]()
    samples = samples - samples.mean()
    return np.asarray(samples / np.abs(samples).max())


@lru_cache
def _own_bits(name: str) -> float:
    return bits_to_reach(maps.methods([OWN], ())[0].rate_points, signal(name), WANTED_SNR_DB)


def measure_kind(trial: Trial) -> Measured:
    """Compare the bits that a set of rate points needs for a signal at WANTED_SNR_DB with those of OWN. Raises
    CodecError.
    """
    bits, own = bits_to_reach(trial.rate_points, signal(trial.case), WANTED_SNR_DB), _own_bits(trial.case)
    if math.isinf(bits):
        return Measured(Outcome.FAILS, {"ratio": None, "own_bits": own}, f"{WANTED_SNR_DB:g} dB are not reached")
    ratio = bits / own
    figures = {"ratio": ratio, "bits_per_sample": bits, "own_bits": own}
    effect = f"{bits:.2f} bits per sample where {OWN} takes {own:.2f}"
    return graded(ratio, HELD_RATIO, FAILED_RATIO, figures, effect)


def measure_quiet(trial: Trial) -> Measured:
    """Code a texture whose second half is quieter, and grade that half as a signal. Raises CodecError."""
    samples = texture(seconds=2 * SECONDS)
    second = slice(len(samples) // 2, len(samples))
    samples[second] *= 10 ** (-trial.value / 20)
    heard, stream = signals.decoded(samples, RATE_HZ, trial.rate_point)
    measured = signals.judge(samples[second], heard[second], signals.texture_snr_db(trial.rate_point))
    return signals.with_bits(measured, stream, heard)


def measure_level(trial: Trial) -> Measured:
    """Code a texture at a wrong level, and grade it by the SNR at the right one. Raises CodecError."""
    rate_point, runtime = trial.rate_point, trial.method.rpartition(", ")[2]
    samples = _clicks(texture()) if trial.case == "texture with clicks" else texture()
    stream = encoded(samples, RATE_HZ, rate_point)
    heard = {each: _by_runtime(stream, each) for each in {runtime, "core"}}
    own = _by_runtime(encoded(samples, RATE_HZ, replace(rate_point, setting=_levelled(rate_point, 0.0))), runtime)
    snr_db, own_db = codec.snr_db(samples, heard[runtime]), codec.snr_db(samples, own)
    assert snr_db is not None and own_db is not None, "a texture is not silent"
    louder = signals.louder_db(samples, heard[runtime])
    alike_db = codec.snr_db(heard[runtime], heard["core"])
    figures = {
        "snr_db": snr_db,
        "own_level_snr_db": own_db,
        "louder_db": louder,
        "bits_per_sample": 8 * stream.size_bytes / samples.size,
        "core_against_this_db": alike_db if alike_db is not None and math.isfinite(alike_db) else None,
    }
    effect = f"SNR {snr_db:z.1f} dB instead of {own_db:.1f}, {figures['bits_per_sample']:.2f} bits per sample"
    if snr_db < FAILED_SNR_DB or louder > FAR_LOUDER_DB:
        return Measured(Outcome.FAILS, figures, effect)
    holds = snr_db >= max(signals.MIN_SNR_DB, own_db - LOST_DB)
    return Measured(Outcome.HOLDS if holds else Outcome.DEGRADED, figures, effect)


def _by_runtime(stream: Stream, runtime: str) -> Signal:
    return replace(stream, runtime=runtime).decode()


def _levelled(rate_point: RatePoint, off_db: float) -> Setting:
    return {**rate_point.parameters, "level": 10 ** (off_db / 20)}


def _families(scope: Scope) -> Iterator[Trial]:
    return (Trial(method.name, rate_points=method.rate_points) for method in scope.learned)


def _compared(scope: Scope) -> Iterator[Trial]:
    """Yield the beginnings of trials of models at their middle rate point, and of OWN, if there are models."""
    own = [method for method in scope.methods if method.name == OWN]
    return at_level("middle", [*scope.learned, *own] if scope.learned else [])


def _levels(scope: Scope) -> Iterator[Trial]:
    for begun in at_level("middle", scope.learned):
        if "level" in CODECS[begun.rate_point.codec].parameters:
            for runtime in runtimes(begun.rate_point.trained):
                for off_db in scope.some(OFF_LEVEL_DB, 5):
                    off = replace(begun.rate_point, setting=_levelled(begun.rate_point, off_db))
                    yield Trial(f"{begun.method}, {runtime}", "", off.text, off_db, (off,))


KINDS = Map("learned_kinds", globals(), [Row(measure_kind, _families, tuple(SIGNALS), case_step=5)])
QUIET = Map("learned_quiet", globals(), [Row(measure_quiet, _compared, ["texture"], QUIETER_DB, value_step=3)])
LEVEL = Map("learned_level", globals(), [Row(measure_level, _levels, ["texture", "texture with clicks"])])
MAPS = (KINDS, QUIET, LEVEL)
