"""Writes the page of the shape for touch, and its tables: `python -m studies.perceptual FOLDER --out docs/benchmarks`.

FOLDER holds WAV files of acceleration, such as the development recordings. `--peers` names a CSV of other codecs on
them: rows of trace, codec, bits_per_sample and the fields of SCALES.
"""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import click
import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy import signal

from studies.page import FOLDER, OUT, errors_in_one_line, render, results_folder, write
from vibrocast import codec, textures
from vibrocast.codec import metrics
from vibrocast.codec.encoding import DEFAULT_SNR_DB, encode_recording
from vibrocast.codec.stream import as_stream
from vibrocast.codec.threshold import MAX_HZ, SKIN_MIN_HZ, band_parts, read_threshold, threshold_amplitude
from vibrocast.evaluation import bd_rate
from vibrocast.evaluation.bd_rate import SNR, SPQI, ST_SIM_2800
from vibrocast.evaluation.curves import Curve, Panel, curves
from vibrocast.evaluation.tables import write_table
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.planner.band import MARGIN_DB, error_over_threshold_db
from vibrocast.textures import Recording

UNIT = "m/s^2"
LEVELS = {"lmt": 30.0, "p1918": 10.0, "textsense": 3.0, "vibtac12": 30.0}
"""Assumed acceleration of full scale in m/s^2 by the beginning of a recording's name; 10 for others. The gains of these
recordings are not known."""
TOUCHES = (0.0, 0.1, codec.DEFAULT_TOUCH, 0.5, 0.75, 1.0)
SCALES = (SNR, ST_SIM_2800, SPQI)
STEPS = tuple(2 ** (exponent / 2) for exponent in range(5, -14, -1))
FLAT_SNR_DB = 15.0
SHIFTS_DB = (-0.6, -0.3, 0.3, 0.6, 0.0)  # the last is the coding to report
DRAWS, DRAW_DB = 20, 4.0
FLAT, BEST_OTHER = "flat", "best other codec"

Row = dict[str, Any]
Points = Sequence[Sequence[float]]
"""Bits per sample of one codec on one recording, each with the qualities of SCALES."""


@click.command()
@FOLDER
@OUT
@click.option("--peers", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="CSV of other codecs.")
def main(folder: Path, out: Path, peers: Path | None) -> None:
    """Measure the shape for touch on a folder of recordings, and write the page perceptual.md."""
    bits, coded, unfelt = [], [], []
    with errors_in_one_line():
        others = read_peers(peers) if peers else {}
        for path in sorted(folder.glob("*.wav")):
            recording = textures.load(path, unit=UNIT, full_scale=LEVELS.get(path.stem.partition("-")[0], 10.0))
            of_touches = {touch: measured(recording, touch) for touch in TOUCHES}
            bits += compared(path.stem, of_touches, others.get(path.stem, {}).values())
            coded += as_coded(recording)
            unfelt += [least_unfelt(recording, touch) for touch in (0.0, 1.0)]
            click.echo(path.stem, err=True)
        if not bits:
            raise click.ClickException(f"{folder} holds no WAV file; give a folder of recordings")
        results = results_folder(out)
        for name, rows in {"perceptual": bits, "perceptual_default": coded, "perceptual_unfelt": unfelt}.items():
            write_table(results / f"{name}.csv", pl.DataFrame(rows))
        means = over_recordings(bits)
        lines = [
            Curve(f"at equal {scale.name}", TOUCHES, [means[touch, scale.name, FLAT][0] for touch in TOUCHES])
            for scale in SCALES
        ]
        curves(results / "perceptual.svg", [Panel("", "strength", "bits re flat, %", lines, lines=(0,))])
        write(
            out / "perceptual.md",
            page(bits, coded, unfelt, sorted({each for some in others.values() for each in some})),
        )


def read_peers(path: Path) -> dict[str, dict[str, list[list[float]]]]:
    """Return the points of other codecs, by recording and codec. Raises OSError."""
    found: dict[str, dict[str, list[list[float]]]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["codec"] != "flac":  # which is lossless
                values = [float(row[name] or "nan") for name in ("bits_per_sample", *(each.field for each in SCALES))]
                found.setdefault(row["trace"], {}).setdefault(row["codec"], []).append(values)
    return found


def source_of(recording: Recording, touch: float) -> codec.Source:
    """Return a recording, ready to be coded with a strength."""
    rate_hz = round(recording.rate_hz)
    shape = codec.shape_setting(codec.codec_by_name(codec.DEFAULT_CODEC), touch, rate_hz, UNIT)
    return codec.Source(recording.samples, rate_hz, unit=UNIT, shape=shape)


def coded_at(source: codec.Source, step: float) -> tuple[float, codec.Signal]:
    """Return the bits per sample of a whole file with this step, and the decoded signal."""
    coded = source.encode({"step": step})
    return 8 * as_stream(coded, UNIT).size_bytes / source.samples.size, codec.decode(coded)


def measured(recording: Recording, touch: float) -> Points:
    """Code a recording with steps from the coarsest to the finest."""
    source, points = source_of(recording, touch), []
    for step in STEPS:
        bits, decoded = coded_at(source, step)
        quality = metrics.measure(recording.samples, decoded, recording.rate_hz, UNIT)
        points.append([bits, *(getattr(quality, scale.field) or math.nan for scale in SCALES)])
    return points


def compared(name: str, of_touches: Mapping[float, Points], peers: Iterable[Points]) -> list[Row]:
    """Return the bits of each strength re those of the flat one and, if known, of the best other codec."""
    rows: list[Row] = []
    for place, scale in enumerate(SCALES, 1):
        others, own = (
            [[(point[0], point[place]) for point in points] for points in some] for some in (peers, of_touches.values())
        )
        grid = np.linspace(scale.low, scale.high, 151)
        others = [curve for curve in others if len(bd_rate.monotone_envelope(curve)) >= bd_rate.MIN_POINTS]
        least = np.fmin.reduce([bd_rate.bits_per_sample_at(curve, grid) for curve in others]) if others else None
        for touch, curve in zip(of_touches, own, strict=True):
            percents = {}
            if (rate := bd_rate.bd_rate(own[0], curve, scale)) is not None:
                percents[FLAT] = rate.percent
            if least is not None:
                ratio = np.nanmean(np.log(bd_rate.bits_per_sample_at(curve, grid) / least))
                percents[BEST_OTHER] = 100 * math.expm1(ratio)
            for anchor, percent in percents.items():
                row: Row = {"recording": name, "touch": touch, "quality": scale.name, "anchor": anchor}
                rows.append(row | {"percent": round(percent, 2)})
    return rows


def stationary_db(error: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
    """Return the level of an error (n, channels) in dB re threshold: one row as it is, and one for each draw.

    It is that of the loudest third octave from SKIN_MIN_HZ, in the mean power over time and channels. A draw adds
    a normal deviation of DRAW_DB to the threshold in each third octave.
    """
    highest_hz = min(MAX_HZ, rate_hz / 2 / 2 ** (1 / 6))
    middle_hz = SKIN_MIN_HZ * 2 ** (np.arange(1 + math.floor(3 * math.log2(highest_hz / SKIN_MIN_HZ))) / 3)
    frame = min(len(error), round(rate_hz))
    _, density = signal.welch(error, rate_hz, nperseg=frame, detrend=False, axis=0)
    parts = band_parts(len(density), rate_hz / frame, middle_hz / 2 ** (1 / 6), middle_hz * 2 ** (1 / 6))
    power = density.mean(axis=1) @ parts * rate_hz / frame
    levels_db = 10 * np.log10(2 * power / threshold_amplitude(read_threshold(), middle_hz, UNIT) ** 2)
    deviations_db = np.random.default_rng(1).normal(0, DRAW_DB, (DRAWS, len(middle_hz)))
    return np.array([np.max(levels_db), *np.max(levels_db - deviations_db, axis=1)])


def as_coded(recording: Recording) -> list[Row]:
    """Return a recording as `encode_recording` codes it: flat at FLAT_SNR_DB, and by default.

    Levels are of the error in its loudest third octave, in dB re threshold: in the loudest block, its mean over the
    targets of SHIFTS_DB, and stationary. `lower_draws`: draws in which the stationary level is lower than flat.
    """
    rows: list[Row] = []
    flat_db, rate_hz = np.zeros(0), round(recording.rate_hz)
    for touch, target_db in ((0.0, FLAT_SNR_DB), (codec.DEFAULT_TOUCH, DEFAULT_SNR_DB)):
        blocks_db = []
        for shift_db in SHIFTS_DB:
            coded = encode_recording(recording, rate_hz, snr_db=target_db + shift_db, highpass_hz=None, touch=touch)
            assert coded.quality.felt_error is not None, "the error is not zero"
            blocks_db.append(coded.quality.felt_error.level_db)
        decoded = coded.stream.decode()
        quality = metrics.measure(recording.samples, decoded, rate_hz, UNIT)
        levels_db = stationary_db(recording.samples - decoded, rate_hz)
        flat_db = flat_db if rows else levels_db
        row: Row = {"recording": recording.name, "touch": touch, "bytes": coded.stream.size_bytes}
        row |= {scale.field: round(getattr(quality, scale.field), 4) for scale in SCALES}
        row["weighted_skin_snr_db"] = round(coded.quality.weighted_skin_snr_db or 0.0, 2)
        levels = {"stationary_db": levels_db[0], "block_db": blocks_db[-1], "mean_block_db": fmean(blocks_db)}
        row |= {name: round(float(level_db), 2) for name, level_db in levels.items()}
        rows.append(row | {"lower_draws": int(np.sum(levels_db[1:] < flat_db[1:]))})
    return rows


def least_unfelt(recording: Recording, touch: float) -> Row:
    """Return the least rate at which nobody feels the error, by MARGIN_DB and of the actuator `piezo-stack`."""
    source, threshold = source_of(recording, touch), read_threshold()
    coarse, fine = 16 * 3, -16 * 12  # in 1/16 octave of the step
    while coarse - fine > 1:
        middle = (coarse + fine) // 2
        _, decoded = coded_at(source, 2 ** (middle / 16))
        kept = error_over_threshold_db(recording, decoded, PIEZO_STACK, threshold) <= MARGIN_DB
        coarse, fine = (coarse, middle) if kept else (middle, fine)
    bits, decoded = coded_at(source, 2 ** (fine / 16))
    snr_db = round(codec.snr_db(recording.samples, decoded) or 0.0, 2)
    return {"recording": recording.name, "touch": touch, "bits_per_sample": round(bits, 3), "snr_db": snr_db}


def over_recordings(bits: Sequence[Row]) -> dict[tuple[float, str, str], tuple[float, float]]:
    """Return the mean and the most of the percents, by strength, quality and anchor."""
    keys = ("touch", "quality", "anchor")
    table = pl.DataFrame(bits).group_by(keys).agg(pl.col("percent").mean(), pl.col("percent").max().alias("most"))
    return {row[:3]: row[3:] for row in table.iter_rows()}


def page(bits: Sequence[Row], coded: Sequence[Row], unfelt: Sequence[Row], peers: Sequence[str]) -> str:
    """Return the page; `peers`: the names of the other codecs."""
    flat, shaped = (pl.DataFrame(coded[first::2]) for first in (0, 1))
    return render(
        "perceptual",
        codec=codec.DEFAULT_CODEC,
        default=codec.DEFAULT_TOUCH,
        snrs_db=(FLAT_SNR_DB, DEFAULT_SNR_DB),
        touches=TOUCHES,
        anchors=[FLAT, *([BEST_OTHER] if peers else [])],
        scales=[scale.name for scale in SCALES],
        bits=over_recordings(bits),
        pairs=list(zip(coded[::2], coded[1::2], strict=True)),
        larger=100 * (sum(shaped["bytes"]) / sum(flat["bytes"]) - 1),
        changes_db={name: shaped[name] - flat[name] for name in ("block_db", "mean_block_db", "stationary_db")},
        lower_draws=shaped["lower_draws"].sum(),
        draws=(DRAWS * len(shaped), DRAW_DB),
        unfelt=list(zip(unfelt[::2], unfelt[1::2], strict=True)),
        margin_db=MARGIN_DB,
        peers=peers,
        levels=LEVELS,
    )


if __name__ == "__main__":
    main()
