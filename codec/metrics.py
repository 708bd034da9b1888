"""Quality of a decoded signal against its reference, by seven measures; docs/reference/metrics.md has their rules."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np

from vibrocast.codec.interface import Signal, parts, peak_of
from vibrocast.codec.threshold import TACTILE_BAND_HZ, band_parts, read_threshold, threshold_amplitude

BLOCK_SAMPLES = 512
"""Block of ST-SIM and SPQI at every rate: vibromaf's own."""
SILENCE = 1e-6
"""Below this part of the channel's peak, as RMS, the reference is silent: no block of 16-bit samples that are not all
equal is, as one of 512 that differs by one step is 1.3e-6 of full scale."""
FRAME_S = 0.1
FLOOR = 1e-6
"""Floor of power spectra relative to the reference's mean power in the tactile band, -60 dB."""
THIRD_OCTAVES = np.arange(-14, 0)
"""Bands by their number x: 1000 * 10^(x / 10) Hz in the middle, 40 to 800 Hz. IEC 61260-1:2014, 5.2 to 5.5."""
MAX_MAGNITUDE, MIN_PEAK = 2.0**127, 2.0**-120
"""What the codecs take: between them, no square of a ratio overflows."""


def channel_snrs_db(reference: Signal, decoded: Signal) -> list[float | None]:
    """Return the SNR in dB of each channel of two arrays (n, channels): 10 log10(sum x^2 / sum (x - y)^2).

    None if the reference is silent, infinity if both are equal.
    """
    if reference.shape != decoded.shape:
        raise ValueError(f"a reference of shape {reference.shape}, decoded {decoded.shape}")
    peaks = [peak_of(channel) for channel in reference.T]
    energy, noise = np.zeros(len(peaks)), np.zeros(len(peaks))
    scales = np.array([peak or 1.0 for peak in peaks])
    for part in parts(len(reference)):
        energy += np.sum(np.square(reference[part] / scales), axis=0)
        noise += np.sum(np.square((reference[part] - decoded[part]) / scales), axis=0)
    return [
        (10 * math.log10(signal / error) if error > 0 else math.inf) if peak > 0 else None
        for peak, signal, error in zip(peaks, energy.tolist(), noise.tolist(), strict=True)
    ]


def snr_db(reference: Signal, decoded: Signal) -> float | None:
    """Return the mean of `channel_snrs_db` over the channels that are not silent; None when every channel is silent."""
    ratios = [ratio for ratio in channel_snrs_db(reference, decoded) if ratio is not None]
    return sum(ratios) / len(ratios) if ratios else None


@dataclass(frozen=True)
class Quality:
    """How near a decoded signal is to its reference. None where a measure has no value.

    Attributes:
        snr_db: 10 log10(sum x^2 / sum (x - y)^2) in dB; infinite for an exact copy.
        psnr_db: 10 log10(peak^2 / mean (x - y)^2) in dB. The peak is the largest magnitude of the reference channel.
        st_sim_2800: ST-SIM with its thresholds on an axis of 2800 Hz; 1 for an exact copy.
        st_sim_8000: The same on an axis of 8000 Hz.
        spqi: SPQI, 0 to 1; 1 for an exact copy.
        log_spectral_distance_db: Distance of spectra in the tactile band in dB; 0 for an exact copy.
        third_octave_distance_db: Distance of the third octaves that can be felt, in dB; 0 for an exact copy.
    """

    snr_db: float | None
    psnr_db: float | None
    st_sim_2800: float | None
    st_sim_8000: float | None
    spqi: float | None
    log_spectral_distance_db: float | None
    third_octave_distance_db: float | None


def measure(
    reference: Signal, decoded: Signal, rate_hz: float, unit: str = "full scale", perceptual: bool = True
) -> Quality:
    """Measure float64 arrays (n, channels) in the physical unit, the codec's delay removed.

    `perceptual`: measure ST-SIM and SPQI too, which need the package vibromaf; otherwise they are None.

    `unit`: of "um" and "m/s^2" it is known what can be felt, of others not.

    Every measure is the mean over the channels that have a value; one whose reference is silent has none. Raises
    ValueError on arrays of another or of differing shape, NaN, infinity, magnitudes that no codec takes, or a rate that
    is not a positive number.
    """
    _check(reference, decoded, rate_hz)
    channels = [
        _measure_channel(x, y, rate_hz, unit, ratio, perceptual)
        for x, y, ratio in zip(reference.T, decoded.T, channel_snrs_db(reference, decoded), strict=True)
        if ratio is not None
    ]
    return Quality(
        **{each.name: _mean(getattr(channel, each.name) for channel in channels) for each in fields(Quality)}
    )


def _check(reference: Signal, decoded: Signal, rate_hz: float) -> None:
    if reference.ndim != 2 or reference.shape != decoded.shape:
        raise ValueError(
            f"a reference of shape {reference.shape}, decoded {decoded.shape}; both must be (n, channels) and equal: "
            "resample the reference to the stream's rate, and remove the codec's delay and what follows the end"
        )
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"a rate of {rate_hz} Hz; give the samples' rate, a positive number")
    for name, signal in (("reference", reference), ("decoded signal", decoded)):
        if not np.all(np.abs(signal) <= MAX_MAGNITUDE):
            raise ValueError(f"the {name} holds NaN, infinity or values above 2^127; repair it first")
    peaks = np.max(np.abs(reference), axis=0, initial=0.0)
    if np.any((peaks > 0) & (peaks < MIN_PEAK)):
        raise ValueError("the reference's peak is below 2^-120; use another unit")


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _measure_channel(
    reference: Signal, decoded: Signal, rate_hz: float, unit: str, snr_db: float, perceptual: bool
) -> Quality:
    """Measure one channel (n,) that is not all zero."""
    peak = np.max(np.abs(reference))
    x, y = _blocks_with_signal(reference, decoded, peak) if perceptual else (reference[:0], decoded[:0])
    return Quality(
        snr_db=snr_db,
        psnr_db=snr_db - 10 * math.log10(np.mean(np.square(reference / peak))),
        st_sim_2800=_similarity("st_sim_2800", x, y),
        st_sim_8000=_similarity("st_sim_8000", x, y),
        spqi=_similarity("spqi", x, y),
        log_spectral_distance_db=_log_spectral_distance_db(reference / peak, decoded / peak, rate_hz),
        third_octave_distance_db=_third_octave_distance_db(reference / peak, decoded / peak, rate_hz, unit, peak),
    )


def _blocks_with_signal(reference: Signal, decoded: Signal, peak: float) -> tuple[Signal, Signal]:
    """Return both without blocks in which the reference is silent, and without the samples after the last whole block.

    A silent block has neither correlation nor spectrum, and counts 0 in vibromaf's ST-SIM however well it is decoded.
    Where it is below SILENCE of the unit, the 2.2e-16 that vibromaf adds to divisors would decide the scores.
    """
    whole = len(reference) // BLOCK_SAMPLES * BLOCK_SAMPLES
    x, y = (signal[:whole].reshape(-1, BLOCK_SAMPLES) for signal in (reference, decoded))
    kept = np.std(x, axis=1) >= SILENCE * max(peak, 1.0)
    return x[kept].ravel(), y[kept].ravel()


@cache
def _vibromaf() -> dict[str, Any]:
    """Return vibromaf's metrics by their names in Quality; only who measures needs the package."""
    from vibromaf.metrics.spqi import SPQI
    from vibromaf.metrics.stsim import STSIM
    from vibromaf.signal.perception import PerceptualThreshold
    from vibromaf.signal.transform import PerceptualSpectrumBuilder

    class StSim2800(STSIM):  # type: ignore[misc, unused-ignore]  # vibromaf is not typed
        """ST-SIM with the axis of its thresholds at 2800 Hz."""

        perceptual_spectrum_builder = PerceptualSpectrumBuilder(perceptual_threshold=PerceptualThreshold(2800))

    return {
        "st_sim_2800": StSim2800(eta=2 / 3),
        "st_sim_8000": STSIM(eta=2 / 3),
        "spqi": SPQI(eta=0.3, threshold=-2.0),
    }


def _similarity(name: str, reference: Signal, decoded: Signal) -> float | None:
    """Return vibromaf's score of whole blocks, None for none; 0 for ST-SIM where the blocks correlate negatively."""
    if len(reference) == 0:
        return None
    metric = _vibromaf()[name]
    with np.errstate(divide="ignore"):  # the logarithm of a spectrum's zeros; what is made of it is 0 again
        score = metric.calculate(decoded, reference)
    # A negative mean correlation to the power 2/3 is a complex number.
    return 0.0 if isinstance(score, complex) else float(score)


def _log_spectral_distance_db(reference: Signal, decoded: Signal, rate_hz: float) -> float | None:
    """Return the mean over frames of the RMS difference of log power spectra in the tactile band; peak of reference 1.

    A. H. Gray and J. D. Markel, "Distance measures for speech processing", IEEE Trans. ASSP 24 (1976), the measure d_2;
    L. Rabiner and B.-H. Juang, "Fundamentals of Speech Recognition" (1993), section 4.5.1. Hann windows of 0.1 s that
    overlap by half, without those in which the reference is silent in the band. None where none is left, where the
    signal is shorter than one, and where no bin lies in the band.
    """
    frame = round(FRAME_S * rate_hz)
    frequencies = np.fft.rfftfreq(max(frame, 1), 1 / rate_hz)
    band = (TACTILE_BAND_HZ[0] <= frequencies) & (frequencies <= TACTILE_BAND_HZ[1])
    if len(reference) < frame or not np.any(band):
        return None
    x, y = (_power_spectra(signal, frame)[:, band] for signal in (reference, decoded))
    kept = np.sum(x, axis=1) >= SILENCE**2
    if not np.any(kept):
        return None
    x, y = x[kept], y[kept]
    return _rms_difference_db(x, y, FLOOR * np.mean(x))


def _third_octave_distance_db(
    reference: Signal, decoded: Signal, rate_hz: float, unit: str, peak: float
) -> float | None:
    """Return the mean over frames of the RMS difference of third-octave levels; peak of reference 1.

    The measure d_2 as in `_log_spectral_distance_db`, of levels in bands as by D. H. Klatt, "Prediction of perceived
    phonetic distance from critical-band spectra", ICASSP 1982. The bands are third octaves, because touch distinguishes
    frequencies by about a fifth (A. Israr, H. Z. Tan and C. M. Reed, "Frequency and amplitude discrimination along the
    kinesthetic-cutaneous continuum", J. Acoust. Soc. Am. 120, 2006).

    A level counts as at least the power of a sine at the detection threshold. Where the unit is not physical, the floor
    is FLOOR of the mean power of the reference's bands. Frames in which neither signal exceeds it are left out. None
    where no frame is left, where the signal is shorter than a frame, and where the rate has room for no band.
    """
    frame = round(FRAME_S * rate_hz)
    middles_hz = 1000 * 10 ** (THIRD_OCTAVES / 10)
    lower_hz, upper_hz = middles_hz * 10**-0.05, middles_hz * 10**0.05
    whole = upper_hz <= rate_hz / 2
    if len(reference) < frame or not np.any(whole):
        return None
    parts = band_parts(frame // 2 + 1, rate_hz / frame, lower_hz[whole], upper_hz[whole])
    x, y = (_power_spectra(signal, frame) @ parts for signal in (reference, decoded))
    if unit in ("um", "m/s^2"):
        floor = np.square(threshold_amplitude(read_threshold(), middles_hz[whole], unit) / peak) / 2
    else:
        floor = np.full(np.count_nonzero(whole), FLOOR * np.mean(x))
    kept = np.any(np.maximum(x, y) > floor, axis=1)
    if not np.any(kept):
        return None
    return _rms_difference_db(x[kept], y[kept], floor)


def _rms_difference_db(x: Signal, y: Signal, floor: Signal) -> float:
    """Return the mean over frames of the RMS difference of levels, (frames, bins) of power, at least a floor."""
    differences_db = 10 * np.log10(np.maximum(x, floor) / np.maximum(y, floor))
    return float(np.mean(np.sqrt(np.mean(np.square(differences_db), axis=1))))


def _power_spectra(signal: Signal, frame: int) -> Signal:
    """Return (frames, bins): mean square of the signal in each bin, of Hann-windowed frames that overlap by half."""
    window = np.hanning(frame + 1)[:-1]
    frames = np.lib.stride_tricks.sliding_window_view(signal, frame)[:: frame // 2]
    return 2 / (frame * np.sum(window**2)) * np.abs(np.fft.rfft(frames * window)) ** 2
