"""Measures how exactly rates are held: `python -m studies.rate_control RECORDINGS --out docs/benchmarks`."""

import math
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl

from studies import page
from vibrocast import codec, textures
from vibrocast.codec import DEFAULT_CODEC
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, encode_recording
from vibrocast.codec.rate_control import DEFAULT_RATE_BUFFER_S, RateTarget, added_bytes
from vibrocast.codec.source import REFRESH_S
from vibrocast.evaluation.curves import Curve, Panel, curves
from vibrocast.evaluation.tables import as_rows, frame, grouped
from vibrocast.textures import dataset

RATES_BPS = (500, 1000, 2000, 4000, 8000, 20_000)
MAIN_RATES_BPS = (1000, 2000, 4000, 8000)
LARGER_RATE_BUFFERS_S = (0.25, 1.0)
REFRESHES_S = (0.25, 0.5, 1.0, 2.0, math.inf)
MIN_SECONDS = 6.0
"""Recordings are repeated up to so long, so that there are many runs of 2 s in each."""
_LIMIT_PERCENT = 1.0
_DEVIATION = pl.col("furthest_percent").abs().fill_null(0.0)


@dataclass(frozen=True)
class Held:
    """One recording coded at a constant rate, of each channel and with frames.

    `rate_buffer_s`: the rate buffer's size. `rejected`: why the codec cannot, and then nothing else.
    `furthest_percent`: by how much the run of packets of 2 s that is furthest from the rate differs. `snr_...`: of
    packets.
    """

    recording: str
    codec: str
    bits_per_second: int
    rate_buffer_s: float
    packet_ms: float = 0.0
    sent_bps: float = 0.0
    packets_bps: float = 0.0
    furthest_percent: float | None = None
    padding_percent: float = 0.0
    snr_db: float = 0.0
    snr_deviation_db: float = 0.0
    snr_low_db: float = 0.0
    snr_high_db: float = 0.0
    rejected: str = ""


@dataclass(frozen=True)
class RefreshCost:
    """Mean SNR over recordings at a rate with a refresh every `refresh_s` seconds."""

    bits_per_second: int
    refresh_s: float
    snr_db: float


@page.study
@page.FOLDER
def main(folder: Path, out: Path) -> None:
    """Measure rate control on a folder of recordings; write page and charts."""
    recordings = [_repeated(dataset.load(trace)) for trace in dataset.entries(folder)]
    codecs = [name for name, known in codec.CODECS.items() if known.controls_rate]
    cells = [
        *product(recordings, codecs, RATES_BPS, (DEFAULT_RATE_BUFFER_S,)),
        *product(recordings, (DEFAULT_CODEC,), MAIN_RATES_BPS, LARGER_RATE_BUFFERS_S),
    ]
    rows = (measure(*cell) for cell in cells)
    held = page.collected(
        "rates", rows, len(cells), lambda row: f"{row.recording}, {row.codec}, {row.bits_per_second} bit/s"
    )
    refreshes = page.collected(
        "refreshes",
        (measure_refreshes(recordings, *cell) for cell in product(RATES_BPS, REFRESHES_S)),
        len(RATES_BPS) * len(REFRESHES_S),
        lambda row: f"{row.bits_per_second} bit/s",
    )
    done = frame(held, Held).filter(pl.col("rejected") == "")
    results = page.results_folder(out)
    plot_codecs(results / "rate_control_codecs.png", done.filter(rate_buffer_s=DEFAULT_RATE_BUFFER_S))
    plot_rate_buffers(
        results / "rate_control_buffers.png",
        done.filter(pl.col("bits_per_second").is_in(MAIN_RATES_BPS), codec=DEFAULT_CODEC),
    )
    tables = (("rate_control.csv", held, Held), ("rate_control_refreshes.csv", refreshes, RefreshCost))
    page.publish(out, "further_results", rendered(held, refreshes, dataset.printable(folder.name)), tables)


def _repeated(recording: textures.Recording) -> textures.Recording:
    resampled = textures.resample(recording, DEFAULT_STREAM_RATE_HZ)
    times = math.ceil(MIN_SECONDS / resampled.seconds)
    samples = np.tile(resampled.samples, (times, 1))
    return textures.Recording(samples, resampled.rate_hz, resampled.unit, recording.name)


def measure(recording: textures.Recording, codec_name: str, rate_bps: int, rate_buffer_s: float) -> Held:
    """Code a recording at a constant rate for each channel, frames included."""
    given_s = None if rate_buffer_s == DEFAULT_RATE_BUFFER_S else rate_buffer_s
    target = RateTarget(constant_rate_bps=rate_bps * recording.channels, rate_buffer_s=given_s)
    try:
        encoding = encode_recording(recording, target=target, codec_name=codec_name, highpass_hz=None)
    except codec.CodecError as error:
        return Held(recording.name, codec_name, rate_bps, rate_buffer_s, rejected=str(error))
    outcome = encoding.outcome
    assert outcome is not None, "there is a target of rate control"
    return Held(
        recording.name,
        codec_name,
        rate_bps,
        rate_buffer_s,
        1000 * outcome.packet_s,
        outcome.sent_bps,
        outcome.packets_bps,
        None if outcome.furthest is None else 100 * outcome.furthest,
        100 * outcome.padding,
        outcome.snr_db,
        outcome.snr_deviation_db,
        *outcome.snr_range_db,
    )


def measure_refreshes(recordings: Sequence[textures.Recording], rate_bps: int, refresh_s: float) -> RefreshCost:
    """Code recordings by the default codec at a constant rate with a refresh every so often; infinity = the first."""
    ratios_db = []
    for recording in recordings:
        total_bps = rate_bps * recording.channels
        rate_hz = round(recording.rate_hz)
        framing = codec.rate_controlled_framing(total_bps, rate_hz, added_bytes)
        packets = 0 if math.isinf(refresh_s) else max(1, round(refresh_s * rate_hz / framing.packet_samples))
        source = codec.Source.of(recording.samples, rate_hz, DEFAULT_CODEC, recording.unit, live=True)
        policy = codec.ConstantRate(total_bps, added_bytes)
        coded = codec.encode_rate_controlled(source, {}, policy, codec.Framing(framing.packet_samples, packets))
        ratios_db.append(codec.snr_db(recording.samples, coded.decode()))
    return RefreshCost(rate_bps, refresh_s, float(np.mean([ratio for ratio in ratios_db if ratio is not None])))


def rendered(held: Sequence[Held], refreshes: Sequence[RefreshCost], data: str) -> str:
    """Return the page. `data`: the name of the recordings' folder."""
    default = frame(held, Held).filter(rate_buffer_s=DEFAULT_RATE_BUFFER_S)
    done = default.filter(pl.col("rejected") == "")
    cell = pl.col("codec", "bits_per_second")
    means = done.group_by(cell).agg(
        pl.len().alias("kept"),
        pl.col("packet_ms", "padding_percent").mean(),
        added_percent=100 * (pl.col("sent_bps") / pl.col("packets_bps") - 1).mean(),
    )
    cells = default.group_by(cell, maintain_order=True).len().join(means, on=["codec", "bits_per_second"], how="left")
    silent = done.group_by(cell).agg(pl.col("snr_db").max()).filter(pl.col("snr_db") <= 0)
    return page.render(
        "rate_control",
        globals(),
        data=data,
        recordings=len({row.recording for row in held}),
        command=shlex.join(["python", "-m", "studies.rate_control", *sys.argv[1:]]),
        furthest=as_rows(done.filter(pl.col("furthest_percent").is_not_null()).sort(_DEVIATION, descending=True))[0],
        codecs=grouped(as_rows(cells), lambda row: row.codec),
        examples={row.codec: row for row in held if row.rejected}.values(),
        silent=dict(silent.select(cell).sort(cell).iter_rows()),
        infinity=math.inf,
        refresh_s=REFRESH_S,
        refreshes=grouped(refreshes, lambda row: row.bits_per_second),
    )


def plot_codecs(path: Path, rows: pl.DataFrame) -> None:
    """Draw worst deviation, mean SNR and its mean deviation over the rates, a line for each codec. Raises OSError."""
    panels = {
        "worst over 2 s, %": _DEVIATION.max(),
        "mean SNR, dB": pl.col("snr_db").mean(),
        "deviation of SNR, dB": pl.col("snr_deviation_db").mean(),
    }
    on_all = rows.filter(pl.len().over("codec", "bits_per_second") == rows["recording"].n_unique())
    _plot(path, on_all, ("codec", "bits_per_second"), panels, "bit/s, frames included", (_LIMIT_PERCENT,))


def plot_rate_buffers(path: Path, rows: pl.DataFrame) -> None:
    """Draw mean deviations of SNR and rate over the rate buffer's size, a line for each rate. Raises OSError."""
    panels = {"deviation of SNR, dB": pl.col("snr_deviation_db").mean(), "worst over 2 s, %": _DEVIATION.mean()}
    named = rows.sort("bits_per_second").with_columns(rate=pl.format("{} bit/s", "bits_per_second"))
    _plot(path, named, ("rate", "rate_buffer_s"), panels, "rate buffer, s")


def _plot(
    path: Path,
    rows: pl.DataFrame,
    by: tuple[str, str],
    values: Mapping[str, pl.Expr],
    x_label: str,
    levels: Sequence[float] = (),
) -> None:
    """Draw a panel for each of the values. `by`: columns of lines' names and of x. `levels`: of the first panel."""
    name, x = by
    table = rows.group_by(name, x, maintain_order=True).agg(**values)

    def lines(title: str) -> Iterator[Curve]:
        for (line,), own in table.group_by(name, maintain_order=True):
            yield Curve(str(line), *own.sort(x).select(pl.col(x).cast(float), title).to_dict(as_series=False).values())

    panels = [
        Panel(title, x_label, "", list(lines(title)), log_x=True, lines=() if place else levels)
        for place, title in enumerate(values)
    ]
    curves(path, panels, across=1)


if __name__ == "__main__":
    main()
