"""Changes the sample rate of a recording, with a stated band."""

import numpy as np
import soxr

from textures.recording import Recording, TextureError

MAX_SAMPLES = 2**30  # 8 GiB of float64 in all channels together


def resample(recording: Recording, rate_hz: float) -> Recording:
    """Return the recording at another rate: round(n * new / old) samples, at least one; the same one at equal rates.

    The resampler is soxr in quality "HQ", linear phase, no delay. Below, Nyquist is half of the lower rate. Up to
    0.91 Nyquist (1274 Hz for 2800 Hz) the gain is within 0.02 dB of one; what lies above Nyquist is at least 120 dB
    down. The signal is taken as silent before its start and after its end. Raises TextureError on a rate that is not
    positive or makes more than MAX_SAMPLES.
    """
    if not np.isfinite(rate_hz) or rate_hz <= 0:
        raise TextureError(f"sample rate {rate_hz} Hz; it must be positive")
    if rate_hz == recording.rate_hz:
        return recording
    count = max(1, round(len(recording.samples) * rate_hz / recording.rate_hz))
    if count * recording.channels > MAX_SAMPLES:
        raise TextureError(
            f"{recording.name}: {recording.seconds:.0f} s are too long for {rate_hz:g} Hz; "
            "cut the recording or choose a lower rate"
        )
    resampled = soxr.resample(recording.samples, recording.rate_hz, rate_hz, quality="HQ")[:count]
    # soxr rounds the length down and may leave out the last sample.
    padded = np.pad(resampled, ((0, count - len(resampled)), (0, 0)))
    return Recording(padded, rate_hz, recording.unit, recording.name)
