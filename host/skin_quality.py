"""Aligns what a sensor or an actuator model gave with the texture, and compares both at the skin."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vibrocast import textures
from vibrocast.codec import metrics
from vibrocast.codec.threshold import filtered, read_threshold, skin_filter, skin_snr_db
from vibrocast.output.actuator import FOLLOWED_DB
from vibrocast.output.rendering import HIGH_PASS_HZ, displacement_filter
from vibrocast.textures import Recording

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Samples = NDArray[np.float64]

# Cubic splines interpolate the recording between this many points per sample.
_OVERSAMPLING = 8
_ITERATIONS = 12
_HALVINGS = 5
_MIN_CORRELATION = 0.1
MAX_DRIFT_PPM = 500.0
"""Five times what the crystal of a cheap recorder is off; a larger drift is a wrong sample rate, or a wrong fit."""


class AlignmentError(ValueError):
    """A recording that cannot be aligned with the sent signal; the message says what to do."""


@dataclass(frozen=True)
class Alignment:
    """How a recording lies over its reference.

    `lag_s`: from the recording's first sample to where the reference begins in it. `gain`: recorded over sent, negative
    for a sensor the other way round. `drift_ppm`: how much faster the recorder's clock runs.
    """

    lag_s: float
    gain: float
    drift_ppm: float

    def aligned(self, recorded: Samples, samples: int, rate_hz: float) -> Samples:
        """Return a recording (m,) at the first samples of the reference, divided by the gain: float64 (samples,)."""
        numbers = np.arange(samples, dtype=np.float64)
        at = self.lag_s * rate_hz + numbers * (1 + self.drift_ppm / 1e6)
        return np.asarray(_spline(recorded)(np.clip(at, 0, len(recorded) - 1)) / self.gain)


def align(reference: Samples, recorded: Samples, rate_hz: float, drifts: bool = False) -> Alignment:
    """Align a recording (m,) with its reference (n,), both at `rate_hz`; all of the reference lies in the recording.

    Begins at the peak of the cross-correlation; from there the least squared difference over lag and gain, by Gauss and
    Newton. `drifts`: the recorder has a clock of its own, whose drift is fitted too. Steps that raise the difference,
    or leave the peak for its neighbours, are shortened or left out.

    Raises AlignmentError where the two have too little in common, and for a drift of more than MAX_DRIFT_PPM.
    """
    from scipy import signal

    if len(recorded) < len(reference):
        raise AlignmentError("the recording is shorter than the texture; let the sensor's program record {seconds}")
    correlation = signal.correlate(recorded, reference, mode="valid", method="fft")
    peak = int(np.argmax(np.abs(correlation)))
    part = recorded[peak : peak + len(reference)]
    power = float(np.sqrt(np.sum(np.square(reference)) * np.sum(np.square(part))))
    if not power or abs(correlation[peak]) < _MIN_CORRELATION * power:
        raise AlignmentError("the recording does not contain the texture; check the sensor and its sensitivity")
    low, high = _lobe(correlation, peak)
    spline = _spline(recorded)
    slope = spline.derivative()
    numbers = np.arange(len(reference), dtype=np.float64)
    middle = float(np.mean(numbers))

    def values_at(lag: float, stretch: float) -> tuple[Samples, Samples]:
        at = np.clip(lag + numbers + stretch * (numbers - middle), 0, len(recorded) - 1)
        return at, spline(at)

    def difference(values: Samples) -> float:
        factor = np.dot(values, reference) / np.dot(values, values)
        return float(np.sum(np.square(reference - factor * values)))

    lag, stretch = float(peak), 0.0
    at, values = values_at(lag, stretch)
    least = difference(values)
    for _ in range(_ITERATIONS):
        # reference = a values + b slopes + c slopes (numbers - middle), to first order around this lag and stretch.
        slopes = slope(at)
        terms = np.column_stack((values, slopes, slopes * (numbers - middle))[: 3 if drifts else 2])
        factor, *moved = np.linalg.lstsq(terms, reference, rcond=None)[0]
        shift, stretched = (*(np.array(moved) / factor), 0.0)[:2]
        for halving in range(_HALVINGS):
            trial = lag + shift / 2**halving, stretch + stretched / 2**halving
            if low <= trial[0] <= high:
                at, values = values_at(*trial)
                if (now := difference(values)) < least:
                    (lag, stretch), least = trial, now
                    break
        else:
            break
    if abs(1e6 * stretch) > MAX_DRIFT_PPM:
        raise AlignmentError(
            f"the recorder's clock seems to be off by {1e6 * stretch:+.0f} ppm, and none is by more than "
            f"{MAX_DRIFT_PPM:g}; correct the sample rate of the recording"
        )
    _, values = values_at(lag, stretch)
    # Over the power of the sent signal, which has no noise.
    gain = float(np.dot(values, reference) / np.sum(np.square(reference)))
    return Alignment((lag - stretch * middle) / rate_hz, gain, 1e6 * stretch)


def _lobe(correlation: Samples, peak: int) -> tuple[int, int]:
    """Return the lags below and above a peak between which the correlation keeps the peak's sign."""
    other = np.flatnonzero(np.sign(correlation) != np.sign(correlation[peak]))
    behind = int(np.searchsorted(other, peak))
    low = int(other[behind - 1]) if behind > 0 else -1
    return low, int(other[behind]) if behind < len(other) else len(correlation)


def _spline(recorded: Samples) -> "CubicSpline":
    """Return a function of time in samples that interpolates a recording (m,)."""
    from scipy import interpolate, signal

    fine = signal.resample(recorded, _OVERSAMPLING * len(recorded))
    return interpolate.CubicSpline(np.arange(len(fine)) / _OVERSAMPLING, fine)


COMPARED_S = 60
"""Of a signal: a longer comparison takes long, and would say the same."""
# The actuator's part counts where its error is at least a quarter of the power of the codec's.
_NOTICEABLE_DB = 6.0


@dataclass(frozen=True)
class SkinQuality:
    """Quality at the skin, as displacement from 20 to 1000 Hz.

    Each SNR is 10 log10(sum x^2 / sum (x - y)^2), by `codec.threshold.skin_snr_db`. `decoded_snr_db` is that of the
    decoded signal against the texture, `snr_db` that of the skin against the texture. `playing_snr_db` compares the
    skin with the decoded signal, which leaves the codec out. The `weighted_` ones count each frequency in parts of the
    threshold of touch. `gain`: of the skin over the decoded signal, weighted alike; lag and gain are removed before an
    SNR is taken. `st_sim`: of the skin against the texture. None: not known, or an exact copy.
    """

    snr_db: float | None
    decoded_snr_db: float | None
    playing_snr_db: float | None
    st_sim: float | None
    gain: float | None
    weighted_snr_db: float | None
    weighted_decoded_snr_db: float | None
    weighted_playing_snr_db: float | None


def compare_skin(
    sent_um: Samples | None,
    decoded_um: Samples,
    skin_um: Samples,
    rate_hz: int,
    perceptual: bool = True,
    drifts: bool = False,
) -> tuple[SkinQuality, Alignment, Samples]:
    """Compare displacement at the skin (m,) with the texture's and the decoded one, (n,), all at `rate_hz`.

    The skin is aligned with the decoded signal, which it follows: what the codec changed moves neither lag nor gain.
    Returns the skin at the samples of the decoded signal too, (n,), divided by the gain. `sent_um`: None where the
    texture is not known. `perceptual`: ST-SIM as well. `drifts`: a sensor with its own clock recorded the skin. Raises
    AlignmentError.
    """
    margin = np.zeros(rate_hz // 10)  # a model's skin has no time before and after
    padded = np.concatenate((margin, skin_um, margin))
    threshold = read_threshold()
    taps = skin_filter(rate_hz, "um", threshold, len(decoded_um))
    laid = align(filtered(decoded_um, taps), filtered(padded, taps), rate_hz, drifts)
    aligned_um = laid.aligned(padded, len(decoded_um), rate_hz)

    def snrs_db(reference_um: Samples | None, other_um: Samples) -> tuple[float | None, float | None]:
        """Return the SNR in dB, and the one that the threshold weights."""
        if reference_um is None:
            return None, None
        both = reference_um[:, None], other_um[:, None]
        return skin_snr_db(*both, rate_hz, "um"), skin_snr_db(*both, rate_hz, "um", threshold)

    st_sim = None
    if sent_um is not None and perceptual:
        st_sim = metrics.measure(sent_um[:, None], aligned_um[:, None], rate_hz).st_sim_2800
    (at_skin, weighted), (decoded, weighted_decoded), (playing, weighted_playing) = (
        snrs_db(sent_um, aligned_um),
        snrs_db(sent_um, decoded_um),
        snrs_db(decoded_um, aligned_um),
    )
    quality = SkinQuality(at_skin, decoded, playing, st_sim, laid.gain, weighted, weighted_decoded, weighted_playing)
    return quality, replace(laid, lag_s=laid.lag_s - len(margin) / rate_hz), aligned_um


def compare_channels(
    asked_um: Sequence[Samples], rate_hz: int, skin_um: Samples, skin_rate_hz: float
) -> SkinQuality | None:
    """Compare the beginning of displacements (n, channels) at the skin; return the mean over channels that move.

    `asked_um`: the texture's, if known, and the decoded one, at `rate_hz`. None where no channel can be aligned.
    """
    qualities = []
    for channel in range(skin_um.shape[1]):
        moved = Recording(skin_um[:, channel : channel + 1], skin_rate_hz, "um", "skin")
        *sent, decoded = (high_passed(each[: COMPARED_S * rate_hz, channel], rate_hz) for each in asked_um)
        at_skin = high_passed(textures.resample(moved, rate_hz).samples[: len(decoded), 0], rate_hz)
        with contextlib.suppress(AlignmentError):
            quality, *_ = compare_skin(sent[0] if sent else None, decoded, at_skin, rate_hz, perceptual=False)
            qualities.append(quality)
    if not qualities:
        return None
    known = {
        each.name: [value for quality in qualities if (value := getattr(quality, each.name)) is not None]
        for each in fields(SkinQuality)
    }
    return SkinQuality(**{name: float(np.mean(values)) if values else None for name, values in known.items()})


def displacement_above_20_hz(recorded: Recording, rate_hz: int) -> Samples:
    """Return what a sensor recorded as displacement in um, (n,) at `rate_hz`."""
    from scipy import signal

    # Resampled as they are, gravity, a sensor's distance and their drift would be steps at both ends.
    level = replace(recorded, samples=signal.detrend(recorded.samples, axis=0))
    samples = textures.resample(level, rate_hz).samples[:, 0]
    if recorded.unit == "m/s^2":
        return np.asarray(signal.lfilter(*displacement_filter(rate_hz), samples))
    return high_passed(samples, rate_hz)


def high_passed(displacement_um: Samples, rate_hz: int) -> Samples:
    """Return displacement through the high-pass that is in `displacement_filter`, so that the two can be compared."""
    from scipy import signal

    return np.asarray(signal.lfilter(*signal.butter(4, HIGH_PASS_HZ, "highpass", fs=rate_hz), displacement_um))


def limit_note(quality: SkinQuality, gains_db: Mapping[str, float], limited_samples: int) -> str | None:
    """Return in words how the actuator limits what is felt; None where the codec limits it more, or that is unknown.

    `gains_db`: of the displacement over the one asked for, by the frequency in Hz. `limited_samples`: DAC samples that
    the actuator's limits held back.
    """
    decoded_db, playing_db = quality.weighted_decoded_snr_db, quality.weighted_playing_snr_db
    if decoded_db is None or playing_db is None or playing_db >= decoded_db + _NOTICEABLE_DB:
        return None
    missed = {each: gain_db for each, gain_db in gains_db.items() if abs(gain_db) > FOLLOWED_DB}
    reasons = [f"{gain_db:+.0f} dB at {frequency} Hz" for frequency, gain_db in missed.items()]
    if limited_samples:
        reasons.append(f"its limits held back {limited_samples} DAC samples")
    return f"the actuator is the limit: {', '.join(reasons) or 'it begins and ends at rest'}"
