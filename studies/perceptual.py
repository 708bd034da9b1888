"""Writes the page of the perceptual modes, and its tables: `python -m studies.perceptual FOLDER --out docs/benchmarks`.

FOLDER holds WAV files of acceleration, such as the development recordings.
"""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from scipy import signal

from studies.page import FOLDER, OUT, errors_in_one_line, render, results_folder, write, write_rows
from vibrocast import codec, textures
from vibrocast.codec import shaping
from vibrocast.codec.stream import as_stream
from vibrocast.codec.threshold import over_threshold_db, read_threshold, skin_snr_db
from vibrocast.evaluation import metrics
from vibrocast.evaluation.bd_rate import SNR, SPQI, BdRate, bd_rate, bits_per_sample_at, quality_at
from vibrocast.host.planner.band import MARGIN_DB, at_the_skin, error_over_threshold_db
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import displacement_filter
from vibrocast.textures import Recording

CODEC = codec.DEFAULT_CODEC
UNIT = "m/s^2"
LEVELS = {"lmt": 30.0, "p1918": 10.0, "textsense": 3.0, "vibtac12": 30.0}
"""Assumed acceleration of full scale in m/s^2 by the beginning of a recording's name; 10 for others. The gains of these
recordings are not known. Only the rates at which nobody feels the error depend on it."""
STEPS = tuple(2 ** (exponent / 2) for exponent in range(5, -15, -1))
QUALITIES_DB = (10.0, 15.0)
SLOW_HZ = 40.0
PAGE = "perceptual.md"
TABLE = "perceptual.csv"
SKIN_TABLE = "perceptual_skin.csv"
UNFELT_TABLE = "perceptual_unfelt.csv"


@dataclass(frozen=True)
class Coded:
    """One coding of a recording; `slow_db`: noise below 40 Hz at the skin, re the recording there."""

    bits_per_sample: float
    snr_db: float
    spqi: float
    skin_db: float
    weighted_db: float
    slow_db: float


@dataclass(frozen=True)
class BdRow:
    """Bits of a purpose relative to those without one, at equal quality, in percent."""

    recording: str
    purpose: str
    quality: str
    percent: float


@dataclass(frozen=True)
class SkinRow:
    """Quality at the skin, at the rate at which the coding without a purpose has `snr_db`."""

    recording: str
    snr_db: float
    purpose: str
    bits_per_sample: float
    coded_snr_db: float
    skin_db: float
    weighted_db: float
    slow_db: float


@dataclass(frozen=True)
class UnfeltRow:
    """The least rate at which nobody feels the error, with and without a purpose and masking."""

    recording: str
    purpose: str
    masking: bool
    bits_per_sample: float
    snr_db: float


@click.command()
@FOLDER
@OUT
def main(folder: Path, out: Path) -> None:
    """Measure the perceptual modes on a folder of recordings, and write the page perceptual.md."""
    bd_rows: list[BdRow] = []
    skin_rows: list[SkinRow] = []
    unfelt_rows: list[UnfeltRow] = []
    with errors_in_one_line():
        for path in sorted(folder.glob("*.wav")):
            recording = loaded(path)
            curves = {purpose: curve(recording, purpose) for purpose in (None, *shaping.PURPOSES)}
            bd_rows += compared(recording.name, curves)
            skin_rows += skins(recording.name, curves)
            unfelt_rows += unfelt(recording)
            click.echo(recording.name, err=True)
        if not bd_rows:
            raise click.ClickException(f"{folder} holds no WAV file; give a folder of recordings")
        results = results_folder(out)
        write_rows(results / TABLE, bd_rows, BdRow)
        write_rows(results / SKIN_TABLE, skin_rows, SkinRow)
        write_rows(results / UNFELT_TABLE, unfelt_rows, UnfeltRow)
        write(out / PAGE, page(bd_rows, skin_rows, unfelt_rows))


def loaded(path: Path) -> Recording:
    """Return a recording at the level that is assumed for it."""
    level = next((level for begin, level in LEVELS.items() if path.stem.startswith(begin)), 10.0)
    return textures.load(path, unit=UNIT, full_scale=level)


def source_of(recording: Recording, purpose: str | None) -> codec.Source:
    """Return a recording, ready to be coded for a purpose."""
    return codec.Source(recording.samples, round(recording.rate_hz), CODEC, recording.unit, purpose=purpose)


def curve(recording: Recording, purpose: str | None) -> list[Coded]:
    """Code a recording with steps from the coarsest to the finest, and measure each."""
    source, found = source_of(recording, purpose), []
    for step in STEPS:
        coded = source.encode({"step": step})
        decoded = codec.decode(coded)
        quality = metrics.measure(recording.samples, decoded, recording.rate_hz, UNIT)
        judged = recording.samples, decoded, recording.rate_hz, UNIT
        weighted_db = skin_snr_db(*judged, read_threshold())
        if quality.snr_db is None or quality.spqi is None or weighted_db is None or quality.snr_db <= 0:
            continue
        found.append(
            Coded(
                8 * as_stream(coded, UNIT).size_bytes / recording.samples.size,
                quality.snr_db,
                quality.spqi,
                skin_snr_db(*judged) or 0.0,
                weighted_db,
                slow_noise_db(recording, decoded),
            )
        )
    return found


def slow_noise_db(recording: Recording, decoded: codec.Signal) -> float:
    """Return the power of the error below 40 Hz re that of the recording, both as displacement behind the high-pass."""
    powers = []
    for samples in (recording.samples - decoded, recording.samples):
        moved = signal.lfilter(*displacement_filter(round(recording.rate_hz)), samples, axis=0)
        frame = min(len(moved), round(recording.rate_hz))
        frequency_hz, density = signal.welch(moved, recording.rate_hz, nperseg=frame, detrend=False, axis=0)
        powers.append(float(np.sum(density[frequency_hz < SLOW_HZ])))
    return float(10 * np.log10(max(powers[0], 1e-60) / max(powers[1], 1e-60)))


def compared(name: str, curves: dict[str | None, list[Coded]]) -> list[BdRow]:
    """Return the BD-rates of each purpose at equal SNR, SPQI and weighted SNR at the skin."""
    rows = []
    scales: dict[str, tuple[Callable[[Coded], float], object]] = {
        "SNR": (lambda each: each.snr_db, SNR),
        "SPQI": (lambda each: each.spqi, SPQI),
        "weighted SNR at the skin": (lambda each: each.weighted_db, SNR),
    }
    for purpose in shaping.PURPOSES:
        for label, (quality, scale) in scales.items():
            pair = [[(each.bits_per_sample, quality(each)) for each in curves[which]] for which in (None, purpose)]
            rate: BdRate | None = bd_rate(pair[0], pair[1], scale)  # type: ignore[arg-type]
            if rate is not None:
                rows.append(BdRow(name, purpose, label, round(rate.percent, 2)))
    return rows


def skins(name: str, curves: dict[str | None, list[Coded]]) -> list[SkinRow]:
    """Return what reaches the skin with each purpose, at the rates of QUALITIES_DB without a purpose."""
    rows = []
    plain = [(each.bits_per_sample, each.snr_db) for each in curves[None]]
    for snr_db in QUALITIES_DB:
        bits = float(bits_per_sample_at(plain, snr_db))
        for purpose, points in curves.items():
            values = []
            for field in ("snr_db", "skin_db", "weighted_db"):
                values.append(
                    float(quality_at([(each.bits_per_sample, getattr(each, field)) for each in points], bits))
                )
            rates = np.log([each.bits_per_sample for each in points])
            slow_db = float(np.interp(np.log(bits), rates, [each.slow_db for each in points]))
            rounded = [round(value, 2) for value in (*values, slow_db)]
            rows.append(SkinRow(name, snr_db, purpose or "", round(bits, 3), *rounded))
    return rows


def unfelt(recording: Recording) -> list[UnfeltRow]:
    """Return the rates at which the error stays MARGIN_DB below what is felt, of the actuator `piezo-stack`."""
    threshold = read_threshold()

    def without_masking_db(decoded: codec.Signal) -> float:
        error = Recording(recording.samples - decoded, recording.rate_hz, recording.unit, "error")
        skin = at_the_skin(error, PIEZO_STACK)
        return float(np.max(over_threshold_db(skin, recording.rate_hz, threshold)[1]))

    def with_masking_db(decoded: codec.Signal) -> float:
        return error_over_threshold_db(recording, decoded, PIEZO_STACK, threshold)

    rows = []
    for purpose in (None, "threshold"):
        source = source_of(recording, purpose)
        for masking, error_db in ((False, without_masking_db), (True, with_masking_db)):
            coarse, fine = 16 * 3, -16 * 12  # in 1/16 octave of the step
            while coarse - fine > 1:
                middle = (coarse + fine) // 2
                decoded = codec.decode(source.encode({"step": 2 ** (middle / 16)}))
                coarse, fine = (coarse, middle) if error_db(decoded) <= MARGIN_DB else (middle, fine)
            coded = source.encode({"step": 2 ** (fine / 16)})
            snr_db = codec.snr_db(recording.samples, codec.decode(coded))
            bits = 8 * as_stream(coded, UNIT).size_bytes / recording.samples.size
            rows.append(UnfeltRow(recording.name, purpose or "", masking, round(bits, 3), round(snr_db or 0.0, 2)))
    return rows


def page(bd_rows: Sequence[BdRow], skin_rows: Sequence[SkinRow], unfelt_rows: Sequence[UnfeltRow]) -> str:
    """Return the page."""
    recordings = list(dict.fromkeys(row.recording for row in bd_rows))

    def percents(purpose: str, quality: str) -> list[float]:
        return [row.percent for row in bd_rows if (row.purpose, row.quality) == (purpose, quality)]

    qualities = list(dict.fromkeys(row.quality for row in bd_rows))
    bd = {(row.recording, row.purpose, row.quality): row.percent for row in bd_rows}
    means = {
        (purpose, quality): (statistics.fmean(found), max(found))
        for purpose in shaping.PURPOSES
        for quality in qualities
        if (found := percents(purpose, quality))
    }
    skin = {(row.recording, row.snr_db, row.purpose): row for row in skin_rows}
    plain = [row for row in unfelt_rows if not row.purpose and not row.masking]
    best = [row for row in unfelt_rows if row.purpose and row.masking]
    shaped = [row for row in skin_rows if row.purpose == "threshold"]
    return render(
        "perceptual",
        codec=CODEC,
        levels=LEVELS,
        recordings=recordings,
        qualities=qualities,
        purposes=shaping.PURPOSES,
        bd=bd,
        means=means,
        skin=skin,
        snrs_db=QUALITIES_DB,
        worst_weighted_db=min(row.weighted_db - row.snr_db for row in shaped),
        worst_slow_db=max(row.slow_db for row in shaped),
        mean_gain_db=statistics.fmean(
            row.weighted_db - skin[row.recording, row.snr_db, ""].weighted_db for row in shaped
        ),
        unfelt={(row.recording, row.purpose, row.masking): row for row in unfelt_rows},
        unfelt_less=100
        * (statistics.fmean(b.bits_per_sample / a.bits_per_sample for a, b in zip(plain, best, strict=True)) - 1),
        highest_before_db=max(row.snr_db for row in plain),
        highest_after_db=max(row.snr_db for row in best),
        margin_db=MARGIN_DB,
    )


if __name__ == "__main__":
    main()
