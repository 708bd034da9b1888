"""The detection threshold b(F) of vibration at the fingertip: replaceable data, as displacement or as acceleration."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import OVER_POSITION, CodecError

TACTILE_BAND_HZ = (40.0, 800.0)
"""The band of the Pacinian channel (Bolanowski et al., JASA 84, 1988)."""
DETECTION_THRESHOLD = Path(__file__).parent / "data" / "detection_threshold.csv"


def read_threshold(path: Path = DETECTION_THRESHOLD) -> NDArray[np.float64]:
    """Return rows of frequency in Hz, rising, and least felt displacement in dB re 1 um peak: float64 (n, 2).

    The file, one that takes its place included, names its source in lines that begin with #. Raises CodecError.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(line for line in file if not line.startswith("#")))
        values = np.array(rows[1:], dtype=np.float64)
    except (OSError, ValueError, csv.Error) as error:
        raise CodecError(f"{str(path)!r} cannot be read as a detection threshold: {error}") from error
    if not (
        values.ndim == 2
        and values.shape[1] == 2
        and np.all(np.isfinite(values))
        and values[0, 0] > 0
        and np.all(np.diff(values[:, 0]) > 0)
    ):
        raise CodecError(
            f"{path} is no detection threshold; it needs rows of a rising frequency in Hz and a level in dB"
        )
    return values


def band_parts(
    bins: int, spacing_hz: float, lower_hz: NDArray[np.float64], upper_hz: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return which part of each bin of a spectrum lies in each band: float64 (bins, bands).

    The bins are `spacing_hz` apart, the first at 0 Hz; what a bin holds lies evenly between its neighbours'. A power
    spectrum (..., bins) @ these parts is the power in the bands.
    """
    bins_hz = spacing_hz * np.arange(bins)[:, None]
    within_hz = np.minimum(bins_hz + spacing_hz / 2, upper_hz) - np.maximum(bins_hz - spacing_hz / 2, lower_hz)
    parts: NDArray[np.float64] = np.maximum(within_hz, 0) / spacing_hz
    return parts


def threshold_amplitude(rows: NDArray[np.float64], frequency_hz: NDArray[np.float64], unit: str) -> NDArray[np.float64]:
    """Return the least felt amplitude, in `unit` ("um" or "m/s^2"), of vibrations at each frequency.

    `rows` as from `read_threshold`: between them the level is linear over log frequency, beyond them it is that of the
    nearest row. An amplitude a of displacement is (2 pi F)^2 a of acceleration. Raises CodecError for a signal
    without a physical unit.
    """
    if unit == OVER_POSITION:
        raise CodecError("the detection threshold is one over time, and a spatial stream has none; leave it off")
    if unit not in ("um", "m/s^2"):
        raise CodecError(
            "the detection threshold is one of displacement, which a signal relative to full scale does not state; "
            "give --unit and --full-scale, or leave the threshold off"
        )
    nearest_hz = np.clip(frequency_hz, rows[0, 0], rows[-1, 0])
    displacement_um = 10 ** (np.interp(np.log(nearest_hz), np.log(rows[:, 0]), rows[:, 1]) / 20)
    if unit == "um":
        return displacement_um
    return 1e-6 * displacement_um * (2 * np.pi * frequency_hz) ** 2
