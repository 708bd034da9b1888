"""Changes the sample rate of a recording, with a stated band."""

from dataclasses import replace

import numpy as np
import soxr

from vibrocast.memory import shortage
from vibrocast.textures.recording import Recording, Signal, TextureError, check_rate

MAX_RATIO = 1e5  # of the rates: far above, soxr's filters take minutes and gigabytes


def resample(recording: Recording, rate_hz: float) -> Recording:
    """Return the recording at another rate: round(n * new / old) samples; the same one at equal rates.

    The resampler is soxr in quality "HQ", with linear phase and no delay. Relative to the Nyquist frequency of the
    lower rate, the gain is within 0.02 dB of one up to 0.91 Nyquist (1274 Hz for 2800 Hz), and at most -120 dB above
    Nyquist. Before its start and after its end the signal counts as silent. Raises TextureError for a rate that no
    recording has, for one more than MAX_RATIO away, and if the result is shorter than one sample or exceeds the memory.
    """
    check_rate(rate_hz, recording.name)
    if rate_hz == recording.rate_hz:
        return recording
    if not 1 / MAX_RATIO <= rate_hz / recording.rate_hz <= MAX_RATIO:
        raise TextureError(
            f"{recording.name}: {recording.rate_hz:g} Hz are too far from {rate_hz:g} Hz to resample; correct one of "
            "the rates"
        )
    count = round(len(recording.samples) * rate_hz / recording.rate_hz)
    if count < 1:
        raise TextureError(
            f"{recording.name}: {len(recording.samples)} samples at {recording.rate_hz:g} Hz last less than one sample "
            f"at {rate_hz:g} Hz; correct the rate, or record for longer"
        )
    if lack := shortage(8 * count * recording.channels):
        raise TextureError(
            f"{recording.name}: {recording.seconds:.0f} s at {rate_hz:g} Hz {lack}, or choose a lower rate"
        )
    return replace(recording, samples=resampled(recording.samples, recording.rate_hz, rate_hz), rate_hz=rate_hz)


def resampled(samples: Signal, rate_hz: float, wanted_hz: float) -> Signal:
    """Return samples (n, channels) at another rate, as `resample` does, without its checks."""
    if rate_hz == wanted_hz:
        return samples
    count = round(len(samples) * wanted_hz / rate_hz)
    made = soxr.resample(samples, rate_hz, wanted_hz, quality="HQ")[:count]
    # soxr rounds the length down and may leave out the last sample
    return np.pad(made, ((0, count - len(made)), (0, 0)))
