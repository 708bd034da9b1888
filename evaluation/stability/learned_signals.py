"""Signals that trained models may not know: of other kinds, quieter in parts, far from the stated level."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial

import numpy as np
from scipy.signal import butter, sosfilt

from vibrocast import codec
from vibrocast.codec import CODECS, Signal
from vibrocast.codec.stream import Stream
from vibrocast.evaluation.bd_rate import fewest_bits
from vibrocast.evaluation.stability import maps, signals
from vibrocast.evaluation.stability.maps import Group, Map, Place, RatePoint, Rule, Scope, figure, rate_points
from vibrocast.evaluation.stability.signals import FAILED_SNR_DB, FAR_LOUDER_DB, RATE_HZ, SECONDS, encoded, texture
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, Verdict, graded
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
    return bits_to_reach(rate_points(*maps.methods([OWN], ())), signal(name), WANTED_SNR_DB)


def measure_kind(rate_point_set: Sequence[RatePoint], name: str) -> Measured:
    """Compare the bits that a set of rate points needs for a signal at WANTED_SNR_DB with those of OWN. Raises
    CodecError.
    """
    bits, own = bits_to_reach(rate_point_set, signal(name), WANTED_SNR_DB), _own_bits(name)
    if math.isinf(bits):
        return Measured(Outcome.FAILS, {"ratio": None, "own_bits": own}, f"{WANTED_SNR_DB:g} dB are not reached")
    ratio = bits / own
    figures = {"ratio": ratio, "bits_per_sample": bits, "own_bits": own}
    effect = f"{bits:.2f} bits per sample where {OWN} takes {own:.2f}"
    return graded(ratio, HELD_RATIO, FAILED_RATIO, figures, effect)


def measure_quiet(rate_point: RatePoint, quieter_db: float) -> Measured:
    """Code a texture whose second half is quieter, and grade that half as a signal. Raises CodecError."""
    samples = texture(seconds=2 * SECONDS)
    second = slice(len(samples) // 2, len(samples))
    samples[second] *= 10 ** (-quieter_db / 20)
    heard, stream = signals.decoded(samples, RATE_HZ, rate_point)
    return signals.with_bits(
        signals.judge(samples[second], heard[second], signals.texture_snr_db(rate_point)), stream, heard
    )


def measure_level(rate_point: RatePoint, runtime: str, name: str) -> Measured:
    """Code a texture at a wrong level, and grade it by the SNR at the right one. Raises CodecError."""
    samples = _clicks(texture()) if name == "texture with clicks" else texture()
    stream = encoded(samples, RATE_HZ, rate_point)
    heard = {each: _by_runtime(stream, each) for each in {runtime, "core"}}
    own = _by_runtime(
        encoded(samples, RATE_HZ, RatePoint(rate_point.codec, {**rate_point.setting, "level": 1.0}, rate_point.model)),
        runtime,
    )
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
    return dataclasses.replace(stream, runtime=runtime).decode()


def _kinds(scope: Scope) -> list[Trial]:
    return [
        Trial(method.name, name, partial(measure_kind, rate_points(method), name))
        for method in scope.learned
        for name in scope.some(list(SIGNALS), 5)
    ]


def _quiet_passages(scope: Scope) -> Iterator[Trial]:
    compared = [method for method in scope.methods if method.name == OWN] if scope.learned else []
    for method in (*scope.learned, *compared):
        middle = maps.middle_rate_point(method)
        for quieter_db in scope.some(QUIETER_DB, 3):
            quiet = partial(measure_quiet, middle, quieter_db)
            yield Trial(method.name, "texture", quiet, middle.text, quieter_db)


def _levels(scope: Scope) -> Iterator[Trial]:
    for method in scope.learned:
        middle = maps.middle_rate_point(method)
        if "level" not in CODECS[middle.codec].parameters:
            continue
        for off_db in scope.some(OFF_LEVEL_DB, 5):
            rate_point = RatePoint(middle.codec, {**middle.setting, "level": 10 ** (off_db / 20)}, middle.model)
            for runtime in runtimes(middle.trained):
                for name in ("texture", "texture with clicks"):
                    level = partial(measure_level, rate_point, runtime, name)
                    yield Trial(f"{method.name}, {runtime}", name, level, rate_point.text, off_db)


def _quiet_message(cells: Sequence[Verdict]) -> str:
    limit_db = maps.most_hold_up_to(cells)
    return f"Half of the codecs hold up to {limit_db:g} dB quieter" if limit_db else "Few codecs hold a quieter passage"


def _level_message(cells: Sequence[Verdict]) -> str:
    values_db = maps.sound_values(cells)
    return f"A level that is off by {maps.ranges(values_db, OFF_LEVEL_DB) or 'no'} dB does no harm with any model"


KINDS = Map(
    name="learned_kinds",
    group=Group.LEARNED,
    title="Other signals",
    tried=f"Bits are compared with those of `{OWN}`, whose tables adapt to any signal.",
    rule=Rule(
        f"bits at {WANTED_SNR_DB:g} dB SNR, relative to `{OWN}`",
        f"up to {HELD_RATIO:g} times",
        f"more than {FAILED_RATIO:g} times, or not reached",
    ),
    conditions=_kinds,
    message=lambda cells: f"Bits stay near those of {OWN} on every signal {maps.with_methods(cells, 'model')}",
    place=lambda cell: Place(cell.case, cell.method),
    caption=f"bits relative to {OWN}",
    label=figure("ratio", ".1f"),
)
QUIET = Map(
    name="learned_quiet",
    group=Group.LEARNED,
    title="A quiet passage",
    tried=f"The second half of a texture is quieter, and alone counts. `{OWN}` has a fixed step too.",
    rule=signals.SIGNALS.rule,
    conditions=_quiet_passages,
    message=_quiet_message,
    caption="quieter by, dB; SNR of the quiet half in dB",
    label=figure("snr_db"),
    value_name="quieter_db",
    varied="{} dB quieter",
)
LEVEL = Map(
    name="learned_level",
    group=Group.LEARNED,
    title="A wrong level",
    tried="The encoder states a level other than the signal's. The integer core and ONNX Runtime decode.",
    rule=Rule(
        "SNR; level",
        f"SNR at most {LOST_DB:g} dB below the right level's",
        f"SNR below {FAILED_SNR_DB:g} dB; more than {FAR_LOUDER_DB:g} dB louder",
    ),
    conditions=_levels,
    message=_level_message,
    place=maps.by_value_and_case,
    caption="level relative to the signal's, dB; SNR in dB",
    label=figure("snr_db"),
    value_name="level_error_db",
    varied="{} dB",
)
MAPS = (KINDS, QUIET, LEVEL)
