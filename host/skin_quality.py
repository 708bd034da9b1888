"""Compares displacement at the skin with the texture: with the codec and without it, as played and as it could be."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from vibrocast import textures
from vibrocast.codec.threshold import read_threshold, skin_snr_db
from vibrocast.evaluation import metrics
from vibrocast.host.alignment import Alignment, AlignmentError, align
from vibrocast.host.bench_limits import Judged
from vibrocast.output.rendering import HIGH_PASS_HZ, displacement_filter
from vibrocast.textures import Recording

Samples = NDArray[np.float64]

COMPARED_S = 60
"""Of a signal: a longer comparison takes long, and would say the same."""
# An SNR that is lower by less than this needs no reason.
_NOTED_DB = 1.0
# The actuator's part counts where its error is at least a quarter of the power of the codec's.
_NOTICEABLE_DB = 6.0


@dataclass(frozen=True)
class SkinQuality:
    """Quality at the skin, as displacement above 20 Hz.

    `snr_db`, `st_sim`, `gain`: of the skin against the texture. `weighted_snr_db`: the same SNR, with each frequency
    weighted by the threshold of touch (`codec.threshold.skin_power`). `decoded_snr_db`: of the decoded signal against
    the texture, the most that the skin can have. `playing_snr_db`: of the skin against the decoded signal, which leaves
    the codec out. None: not known, or an exact copy.
    """

    snr_db: float | None
    decoded_snr_db: float | None
    playing_snr_db: float | None
    st_sim: float | None
    gain: float | None
    weighted_snr_db: float | None = None


def judged_skin(skin: SkinQuality | None, place: str) -> Iterator[Judged]:
    """Yield the figures at the skin that limits of a bench file judge; `skin`: None = not known."""
    yield Judged("snr_db", place, None if skin is None else skin.snr_db)
    yield Judged("gain", place, None if skin is None else skin.gain)


def compare_skin(
    sent_um: Samples | None, decoded_um: Samples, skin_um: Samples, rate_hz: int, perceptual: bool = True
) -> tuple[SkinQuality, Alignment]:
    """Compare displacement at the skin (m,) with the texture's and the decoded one, (n,), all at `rate_hz`.

    `sent_um`: None where the texture is not known; lag, gain and drift are those against the decoded signal then.
    `perceptual`: ST-SIM as well. Raises AlignmentError.
    """
    margin = np.zeros(rate_hz // 10)  # a model's skin has no time before and after
    padded = np.concatenate((margin, skin_um, margin))
    on_decoded = align(decoded_um, padded, rate_hz)
    playing = metrics.measure(decoded_um[:, None], on_decoded.aligned[:, None], rate_hz, perceptual=False)
    if sent_um is None:
        quality = SkinQuality(None, None, _finite(playing.snr_db), None, _finite(on_decoded.gain))
        return quality, _unpadded(on_decoded, margin, rate_hz)
    laid = align(sent_um, padded, rate_hz)
    at_skin = metrics.measure(sent_um[:, None], laid.aligned[:, None], rate_hz, perceptual=perceptual)
    decoded = metrics.measure(sent_um[:, None], decoded_um[:, None], rate_hz, perceptual=False)
    quality = SkinQuality(
        snr_db=_finite(at_skin.snr_db),
        decoded_snr_db=_finite(decoded.snr_db),
        playing_snr_db=_finite(playing.snr_db),
        st_sim=at_skin.st_sim_2800,
        gain=_finite(laid.gain),
        weighted_snr_db=skin_snr_db(sent_um[:, None], laid.aligned[:, None], rate_hz, "um", read_threshold()),
    )
    return quality, _unpadded(laid, margin, rate_hz)


def compare_channels(
    asked_um: Sequence[Samples], rate_hz: int, skin_um: Samples, skin_rate_hz: float
) -> SkinQuality | None:
    """Compare the beginning of displacements (n, channels) at the skin; return the mean over channels that move.

    `asked_um`: the texture's, if known, and the decoded one, at `rate_hz`. None where the skin does not move alike.
    """
    qualities = []
    for channel in range(skin_um.shape[1]):
        moved = Recording(skin_um[:, channel : channel + 1], skin_rate_hz, "um", "skin")
        *sent, decoded = (high_passed(each[: COMPARED_S * rate_hz, channel], rate_hz) for each in asked_um)
        at_skin = displacement_above_20_hz(moved, rate_hz)[: len(decoded)]
        with contextlib.suppress(AlignmentError):
            quality, _ = compare_skin(sent[0] if sent else None, decoded, at_skin, rate_hz, perceptual=False)
            qualities.append(quality)
    if not qualities:
        return None
    known = {
        each.name: [value for quality in qualities if (value := getattr(quality, each.name)) is not None]
        for each in fields(SkinQuality)
    }
    return SkinQuality(**{name: float(np.mean(values)) if values else None for name, values in known.items()})


def _finite(value: float | None) -> float | None:
    """Return a figure, or None for the infinite SNR of an exact copy, and where a gain is no number."""
    return value if value is not None and math.isfinite(value) else None


def _unpadded(laid: Alignment, margin: Samples, rate_hz: int) -> Alignment:
    return replace(laid, lag_s=laid.lag_s - len(margin) / rate_hz)


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


def note(coding_snr_db: float | None, quality: SkinQuality, unit: str, limited_samples: int) -> str | None:
    """Return why the SNR at the skin is lower than that of the codec, in words; None where it is not.

    `unit`: of the stream. `limited_samples`: DAC samples that the actuator's limits held back.
    """
    if coding_snr_db is None or quality.snr_db is None or quality.snr_db > coding_snr_db - _NOTED_DB:
        return None
    reasons = []
    if quality.decoded_snr_db is not None and quality.decoded_snr_db < coding_snr_db - _NOTED_DB:
        weighs = ", where the noise of acceleration at low frequencies weighs most" * (unit == "m/s^2")
        reasons.append(f"the decoded signal has {quality.decoded_snr_db:.1f} dB as displacement{weighs}")
    best_db = coding_snr_db if quality.decoded_snr_db is None else quality.decoded_snr_db
    if quality.playing_snr_db is not None and quality.playing_snr_db < best_db + _NOTICEABLE_DB:
        cause = f"its limits, at {limited_samples} DAC samples" if limited_samples else "its response, as compensated"
        reasons.append(f"the actuator adds its part by {cause}")
    return "; ".join(reasons) or None
