"""Hard signals, and recordings of the user's: every codec at three of its settings, through whole streams and back."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec
from vibrocast.codec.stream import Stream
from vibrocast.evaluation.cells import RatePoint
from vibrocast.evaluation.stability.maps import Map, Row, Scope, at_levels, at_middle
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, graded
from vibrocast.textures import HIGHPASS_HZ, Recording, highpass  # noqa: F401 - the words of SIGNALS name the first
from vibrocast.textures.generate import wood

Signal = NDArray[np.float64]

RATE_HZ = 2800
SECONDS = 2.0
PEAK = 0.8

SNR_MARGIN_DB = 6.0
FAILED_SNR_DB, MIN_SNR_DB, ENOUGH_SNR_DB = -0.5, 1.0, 40.0
"""SNR below which silence is clearly nearer, below which the signal is lost, and above which quality always holds."""
LOUDER_DB, FAR_LOUDER_DB = 3.0, 6.0
SILENT, NEARLY_SILENT = 1e-4, 1e-2  # of full scale: -80 and -40 dB
PRE_ECHO_HELD_DB, PRE_ECHO_FAILED_DB = -30.0, -6.0

GRAVITY_M_S2 = 9.81
DRIFT_RMS = 8.0
"""Of a drift: how far it goes to either side, relative to the texture's RMS value."""
SWING_HZ = 0.3

RATES_HZ = (1000, 1560, 4000, 5600, 8000, 10_000)
HOUR_S = 3600
MAX_S = 60.0
"""Of a recording: what is coded."""
ONSET_HZ = 250.0
_ONSET_SHIFTS = (0, 7, 19, 37, 61, 97)  # in samples, so that the onset falls anywhere in a block


@dataclass(frozen=True)
class Condition:
    """A hard signal. `judged_from`: the first of its samples that counts. `rejected`: that it must be rejected.

    `tactile`: that it counts above HIGHPASS_HZ only, before coding and after decoding.
    """

    make: Callable[[], Signal]
    rate_hz: int = RATE_HZ
    judged_from: int = 0
    rejected: bool = False
    unit: str = "full scale"
    tactile: bool = False


def texture(rate_hz: int = RATE_HZ, seconds: float = SECONDS, channels: int = 1) -> Signal:
    """Return generated wood, of another piece in each channel, with a peak of PEAK: float64 (n, channels)."""
    samples = np.concatenate([wood(seed, seconds, 50.0, rate_hz).samples for seed in range(channels)], axis=1)
    return np.asarray(PEAK * samples / np.abs(samples).max(axis=0))


def time_s() -> Signal:
    """Return the times of a signal's samples (n, 1), in seconds."""
    return np.arange(round(SECONDS * RATE_HZ)).reshape(-1, 1) / RATE_HZ


def sine(frequency_hz: float) -> Signal:
    """Return a full-scale sine (n, 1)."""
    return np.asarray(np.sin(2 * np.pi * frequency_hz * time_s()))


def _impulse() -> Signal:
    samples = np.zeros_like(time_s())
    samples[len(samples) // 2] = -1.0
    return samples


def _click_above() -> Signal:
    """The texture 60 dB below a click of two samples in its first tenth."""
    samples = 0.001 / PEAK * texture()
    samples[len(samples) // 20 : len(samples) // 20 + 2, 0] = 1.0, -1.0
    return samples


def _sweep() -> Signal:
    """A sine from 10 Hz to half the sample rate."""
    phase = 2 * np.pi * np.cumsum(np.linspace(10, RATE_HZ / 2, len(time_s()))) / RATE_HZ
    return PEAK * np.sin(phase).reshape(-1, 1)


def _of_bits(bits: int) -> Signal:
    scale = 2 ** (bits - 1)
    return np.asarray(np.rint(texture() * scale) / scale)


def _with(value: float) -> Signal:
    samples = texture()
    samples[100] = value
    return samples


def _drifting(course: Signal) -> Signal:
    """The texture on a course (n, 1) from -1 to 1, which goes DRIFT_RMS to either side."""
    samples = texture()
    return samples + DRIFT_RMS * np.std(samples) * course


def tactile_part(samples: Signal, rate_hz: int = RATE_HZ) -> Signal:
    """Return the part of samples (n, channels) above HIGHPASS_HZ, without delay."""
    return highpass(Recording(samples, float(rate_hz), "m/s^2", "signal")).recording.samples


def _high_passed(make: Callable[[], Signal]) -> Signal:
    return tactile_part(make())


DRIFTING: dict[str, Callable[[], Signal]] = {
    "texture with gravity": lambda: texture() + GRAVITY_M_S2,  # of an accelerometer that lies flat
    "texture on a ramp": lambda: _drifting(np.linspace(-1, 1, len(time_s()))[:, None]),
    "texture on a slow swing": lambda: _drifting(sine(SWING_HZ)),
}
CONDITIONS: dict[str, Condition] = {
    "texture": Condition(texture),
    "silence": Condition(lambda: 0 * time_s()),
    "constant 0.5": Condition(lambda: 0 * time_s() + 0.5),
    "one impulse": Condition(_impulse),
    "full-scale square of 50 Hz": Condition(lambda: np.where(time_s() * 50 % 1 < 0.5, 1.0, -1.0)),
    "full-scale square of 1400 Hz": Condition(lambda: np.where(np.arange(len(time_s())) % 2 == 0, 1.0, -1.0)[:, None]),
    "full-scale sine of 5 Hz": Condition(partial(sine, 5.0)),
    "full-scale sine of 250 Hz": Condition(partial(sine, 250.0)),
    "sweep from 10 to 1400 Hz": Condition(_sweep),
    "full-scale white noise": Condition(lambda: np.random.default_rng(0).uniform(-1, 1, time_s().shape)),
    "texture clipped at a third": Condition(lambda: np.clip(texture(), -PEAK / 3, PEAK / 3)),
    "texture at +60 dB": Condition(lambda: 1000 * texture()),
    "texture at -60 dB": Condition(lambda: 0.001 * texture()),
    "texture 60 dB below a click": Condition(_click_above, judged_from=round(0.1 * SECONDS * RATE_HZ)),
    **{name: Condition(make, unit="m/s^2", tactile=True) for name, make in DRIFTING.items()},
    **{
        f"{name}, high-passed": Condition(partial(_high_passed, make), unit="m/s^2", tactile=True)
        for name, make in DRIFTING.items()
    },
    "texture of 8 bits": Condition(partial(_of_bits, 8)),
    "texture of 4 bits": Condition(partial(_of_bits, 4)),
    "texture on 16 channels": Condition(partial(texture, channels=16)),
    **{f"texture at {rate_hz} Hz": Condition(partial(texture, rate_hz), rate_hz) for rate_hz in RATES_HZ},
    "1 sample": Condition(lambda: texture()[100:101]),
    "2 samples": Condition(lambda: texture()[100:102]),
    "31 samples": Condition(lambda: texture()[100:131]),
    "513 samples": Condition(lambda: texture()[100:613]),
    "no sample": Condition(lambda: texture()[:0], rejected=True),
    "a NaN": Condition(partial(_with, math.nan), rejected=True),
    "an infinity": Condition(partial(_with, math.inf), rejected=True),
    "17 channels": Condition(partial(texture, channels=17), rejected=True),
    "peak of 1e-40": Condition(lambda: 1e-40 * texture(), rejected=True),
}
LONG_CASE = "texture of 1 hour"


def decoded(samples: Signal, rate_hz: int, rate_point: RatePoint, unit: str = "full scale") -> tuple[Signal, Stream]:
    """Code a signal into a whole stream; return the decoded samples and the stream. Raises as codec.encode."""
    stream = encoded(samples, rate_hz, rate_point, unit)
    return stream.decode(), stream


def encoded(
    samples: Signal, rate_hz: int, rate_point: RatePoint, unit: str = "full scale", live: bool = False
) -> Stream:
    """Code a signal into a whole stream. Raises as codec.encode."""
    return codec.encode(
        samples, rate_hz, rate_point.parameters, codec=rate_point.codec, unit=unit, live=live, model=rate_point.model
    )


@lru_cache
def texture_snr_db(rate_point: RatePoint) -> float:
    """Return the SNR of the texture at a setting, with which other signals are compared."""
    samples = texture()
    return codec.snr_db(samples, decoded(samples, RATE_HZ, rate_point)[0]) or 0.0


def louder_db(reference: Signal, heard: Signal) -> float:
    """Return by how many dB a signal's peak, or its RMS value if that is more, exceeds the reference's."""
    peaks = np.abs(heard).max() / np.abs(reference).max()
    powers = np.sqrt(np.mean(heard**2) / np.mean(reference**2))
    return 20 * math.log10(max(peaks, powers, 1e-10))


def judge(reference: Signal, heard: Signal, texture_snr_db: float) -> Measured:
    """Return the outcome for a signal and its decoded samples, by the rule of SIGNALS."""
    if not np.isfinite(heard).all():
        return Measured(Outcome.FAILS, {}, "not finite")
    if not reference.any():
        peak = float(np.abs(heard).max())
        effect = "" if peak <= SILENT else f"noise of peak {peak:.2g}"
        return graded(peak, SILENT, NEARLY_SILENT, {"peak": peak}, effect)
    snr_db, louder = codec.snr_db(reference, heard), louder_db(reference, heard)
    assert snr_db is not None, "a signal that is not silent has an SNR"
    wanted_db = max(MIN_SNR_DB, min(texture_snr_db - SNR_MARGIN_DB, ENOUGH_SNR_DB))
    figures = {"snr_db": snr_db, "texture_snr_db": texture_snr_db, "louder_db": louder}
    if snr_db < FAILED_SNR_DB or louder > FAR_LOUDER_DB:
        effect = f"{louder:+.1f} dB louder" if louder > FAR_LOUDER_DB else f"SNR {snr_db:z.1f} dB"
        return Measured(Outcome.FAILS, figures, effect)
    if snr_db < MIN_SNR_DB:
        return Measured(Outcome.DEGRADED, figures, f"SNR {snr_db:z.1f} dB: nothing of the signal is left")
    if snr_db < wanted_db:
        return Measured(Outcome.DEGRADED, figures, f"SNR {snr_db:.1f} dB instead of {texture_snr_db:.1f}")
    if louder > LOUDER_DB:
        return Measured(Outcome.DEGRADED, figures, f"{louder:+.1f} dB louder")
    return Measured(Outcome.HOLDS, figures)


def with_bits(measured: Measured, stream: Stream, heard: Signal) -> Measured:
    """Return a measurement of a stream that decodes to `heard`, with its bits per sample among the figures."""
    bits = 8 * stream.size_bytes / heard.size
    return replace(measured, figures={**measured.figures, "bits_per_sample": bits})


def measure(trial: Trial) -> Measured:
    """Code one of CONDITIONS and grade the decoded samples. Raises CodecError where the codec rejects it."""
    condition = CONDITIONS[trial.case]
    samples = condition.make()
    heard, stream = decoded(samples, condition.rate_hz, trial.rate_point, condition.unit)
    wanted = samples
    if condition.tactile:
        wanted, heard = (tactile_part(each, condition.rate_hz) for each in (samples, heard))
    judged_from = slice(condition.judged_from, None)
    measured = judge(wanted[judged_from], heard[judged_from], texture_snr_db(trial.rate_point))
    return with_bits(measured, stream, heard)


def measure_hour(trial: Trial) -> Measured:
    """Code and decode an hour, and grade its last minute. Raises CodecError."""
    minute = texture(seconds=60)
    heard, stream = decoded(np.tile(minute, (HOUR_S // 60, 1)), RATE_HZ, trial.rate_point)
    measured = judge(minute, heard[-len(minute) :], texture_snr_db(trial.rate_point))
    return with_bits(measured, stream, heard)


def measure_onset(trial: Trial) -> Measured:
    """Code a sine that begins after silence, and grade the worst of several places within a block."""
    figures: dict[str, float] = {}
    for shift in _ONSET_SHIFTS:
        onset = RATE_HZ // 2 + shift
        samples = np.zeros((RATE_HZ + shift, 1))
        samples[onset:, 0] = PEAK * np.cos(2 * np.pi * ONSET_HZ * np.arange(RATE_HZ // 2 + RATE_HZ % 2) / RATE_HZ)
        heard, _ = decoded(samples, RATE_HZ, trial.rate_point)
        error = heard - samples
        first = slice(onset, onset + RATE_HZ // 50)
        level = np.mean(samples[first] ** 2)
        for name, part in (
            ("pre_echo_5ms_db", slice(onset - RATE_HZ // 200, onset)),
            ("pre_echo_20ms_db", slice(onset - RATE_HZ // 50, onset)),
            ("noise_after_db", first),
        ):
            ratio_db = 10 * math.log10(max(float(np.mean(error[part] ** 2) / level), 1e-12))
            figures[name] = max(figures.get(name, -math.inf), ratio_db)
    before_db = figures["pre_echo_5ms_db"]
    if figures["noise_after_db"] > -MIN_SNR_DB:
        return Measured(Outcome.DEGRADED, figures, "nothing of the onset is left")
    effect = f"{before_db:.0f} dB in the 5 ms before the onset"
    return graded(before_db, PRE_ECHO_HELD_DB, PRE_ECHO_FAILED_DB, figures, effect)


def measure_recording(trial: Trial) -> Measured:
    """Code a recording, at most its first MAX_S, and grade the decoded samples. Raises CodecError."""
    recording = trial.recording
    assert recording is not None, "the map's trials have one"
    rate_hz = round(recording.rate_hz)
    samples = recording.samples[: round(MAX_S * rate_hz)]
    heard, stream = decoded(samples, rate_hz, trial.rate_point, recording.unit)
    return with_bits(judge(samples, heard, texture_snr_db(trial.rate_point)), stream, heard)


def of_recordings(scope: Scope) -> Iterator[Trial]:
    """Yield the beginnings of trials of every method with each recording, at its three rate points."""
    for begun in at_levels(scope):
        for recording in scope.recordings:
            yield replace(begun, case=recording.name, recording=recording)


RECORDINGS = Map("recordings", globals(), [Row(measure_recording, of_recordings)])
SIGNALS = Map(
    "signals",
    globals(),
    [
        Row(measure_hour, lambda scope: () if scope.quick else at_middle(scope), [LONG_CASE]),
        Row(
            measure,
            at_levels,
            tuple(CONDITIONS),
            case_step=17,
            rejected=[name for name, condition in CONDITIONS.items() if condition.rejected],
        ),
    ],
)
ONSETS = Map(
    "pre_echo",
    globals(),
    [
        Row(
            measure_onset,
            lambda scope: (replace(begun, case=f"{begun.level} rate point") for begun in at_levels(scope)),
        )
    ],
)
MAPS = (RECORDINGS, SIGNALS, ONSETS)
