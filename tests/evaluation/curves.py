"""Rate-distortion curves whose comparison is known beforehand, for the tests of this room."""

from collections.abc import Sequence

from evaluation.points import Point

SAMPLES = 1_000_000


def curve(
    snrs_db: Sequence[float],
    rate_factor: float = 1.0,
    db_per_bit: float = 6.0,
    trace: str = "trace",
    codec: str = "mdct",
) -> list[Point]:
    """Return points of bits per sample = rate_factor * (1 + SNR / db_per_bit), to a millionth of a bit."""
    bits = [rate_factor * (1 + snr_db / db_per_bit) for snr_db in snrs_db]
    return [
        Point(trace, codec, f"{snr_db} dB", SAMPLES, round(SAMPLES * rate / 8), snr_db)
        for snr_db, rate in zip(snrs_db, bits, strict=True)
    ]
