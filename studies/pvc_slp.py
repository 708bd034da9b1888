"""Measures other readings of PVC-SLP, the anchor of the EVA paper, and the bits of codecs relative to each of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

from vibrocast import codec, textures
from vibrocast.errors import InputError
from vibrocast.evaluation import cells
from vibrocast.evaluation.bd_rate import Scale
from vibrocast.evaluation.comparison import PAPER_SCALES, REFERENCE, Measurements, pair_bd_rates
from vibrocast.evaluation.points import Point
from vibrocast.textures import dataset

BANDS = tuple(Scale("snr_db", f"{low} to {high} dB", low, high) for low, high in ((3, 7), (7, 11), (11, 15), (15, 20)))
"""Where EVA has its 8 models, the lowest first."""
POINTS, TABLE = "pvc_slp_points.csv", "pvc_slp.csv"


@dataclass(frozen=True)
class Sensitivity:
    """Bits of a codec relative to one reading of PVC-SLP at equal quality, in percent: means over `traces` recordings.

    `quality` is a field of Point. `percent`: by this project's method from `low` to `high`. Of the others, by the
    paper's method over all qualities: `cubic_percent`, `best_percent` of the recording `best`, and the number of
    recordings with fewer bits, `won`.
    """

    anchor: str
    codec: str
    quality: str
    low: float
    high: float
    percent: float
    cubic_percent: float
    best_percent: float
    best: str
    won: int
    traces: int


def readings() -> dict[str, str]:
    """Return the settings that make each reading, as text: REFERENCE as it ships first."""
    return {
        name: cells.setting_text({key: value for key, value in points.settings[0].items() if key != "quality"})
        for name, points in codec.CODECS[REFERENCE].rate_point_sets.items()
    }


def load(folder: Path, trace: str) -> textures.Recording:
    """Return a recording of the folder that a benchmark measured. Raises InputError, TextureError or OSError."""
    entries = {entry.name: entry for entry in dataset.entries(folder)}
    if trace not in entries:
        raise InputError(f"{folder}: no recording {trace!r}; give the folder that the benchmark measured")
    return dataset.load_highpassed(entries[trace], None).recording


def points(folder: Path, measurements: Measurements) -> Iterator[Point]:
    """Yield the points of all readings that the measurements lack, on their compared recordings; no times.

    Raises as `load`, and CodecError.
    """
    methods = cells.methods([name for name in readings() if name not in measurements.curves])
    for trace in measurements.compared:
        recording = load(folder, trace)
        for method in methods:
            for rate_point in method.rate_points:
                yield cells.Cell(trace, recording, method, rate_point, 0).measure().point


def with_points(measurements: Measurements, more: Sequence[Point]) -> Measurements:
    """Return measurements with further points."""
    return replace(measurements, points=[*measurements.points, *more])


def sensitivity(measurements: Measurements, names: Sequence[str]) -> Iterator[Sensitivity]:
    """Yield the bits of codecs relative to each measured reading, at PAPER_SCALES and in BANDS."""
    for anchor in readings():
        for name in names:
            for scale in (*PAPER_SCALES, *BANDS) if anchor in measurements.curves else ():
                rates = pair_bd_rates(measurements, [(scale, anchor, name)]).sort("cubic_percent")
                if rates.is_empty():
                    continue
                percents, cubic_percents = rates["percent"].to_list(), rates["cubic_percent"].to_list()
                yield Sensitivity(
                    anchor,
                    name,
                    scale.field,
                    scale.low,
                    scale.high,
                    fmean(percents),
                    fmean(cubic_percents),
                    cubic_percents[0],
                    rates["trace"][0],
                    sum(percent < 0 for percent in cubic_percents),
                    len(rates),
                )
