"""Measures how exactly rates are held: `python -m studies.rate_control RECORDINGS --out docs/benchmarks`."""

import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl

from studies import page
from vibrocast import codec, textures
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ, encode_recording
from vibrocast.codec.rate_control import RateTarget
from vibrocast.evaluation.curves import Curve, Panel, curves
from vibrocast.evaluation.tables import as_rows, by, frame
from vibrocast.textures import dataset

RATES_BPS = (500, 1000, 2000, 4000, 8000, 20_000)
MIN_SECONDS = 6.0
"""Recordings are repeated up to so long, so that there are many runs of 2 s in each."""
_LIMIT_PERCENT = 1.0
_DEVIATION = pl.col("furthest_percent").abs().fill_null(0.0)


@dataclass(frozen=True)
class Held:
    """One recording coded at a constant rate, of each channel and with frames.

    `rejected`: why the codec cannot, and then nothing else.
    `furthest_percent`: by how much the run of packets of 2 s that is furthest from the rate differs. `snr_...`: of
    packets.
    """

    recording: str
    codec: str
    bits_per_second: int
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


@page.study
@page.FOLDER
def main(folder: Path, out: Path) -> None:
    """Measure rate control on a folder of recordings; write its part of a page and a chart."""
    recordings = [_repeated(dataset.load(trace)) for trace in dataset.entries(folder)]
    codecs = [name for name, known in codec.CODECS.items() if known.controls_rate]
    cells = list(product(recordings, codecs, RATES_BPS))
    rows = (measure(*cell) for cell in cells)
    held = page.collected(
        "rates", rows, len(cells), lambda row: f"{row.recording}, {row.codec}, {row.bits_per_second} bit/s"
    )
    plot(page.results_folder(out) / "rate_control_codecs.png", frame(held, Held).filter(pl.col("rejected") == ""))
    text = rendered(held, dataset.printable(folder.name))
    page.publish(out, "further_results", text, [("rate_control.csv", held, Held)])


def _repeated(recording: textures.Recording) -> textures.Recording:
    resampled = textures.resample(recording, DEFAULT_STREAM_RATE_HZ)
    times = math.ceil(MIN_SECONDS / resampled.seconds)
    samples = np.tile(resampled.samples, (times, 1))
    return textures.Recording(samples, resampled.rate_hz, resampled.unit, recording.name)


def measure(recording: textures.Recording, codec_name: str, rate_bps: int) -> Held:
    """Code a recording at a constant rate for each channel, frames included."""
    target = RateTarget(constant_rate_bps=rate_bps * recording.channels)
    try:
        encoding = encode_recording(recording, target=target, codec_name=codec_name, highpass_hz=None)
    except codec.CodecError as error:
        return Held(recording.name, codec_name, rate_bps, rejected=str(error))
    outcome = encoding.outcome
    assert outcome is not None, "there is a target of rate control"
    return Held(
        recording.name,
        codec_name,
        rate_bps,
        1000 * outcome.packet_s,
        outcome.sent_bps,
        outcome.packets_bps,
        None if outcome.furthest is None else 100 * outcome.furthest,
        100 * outcome.padding,
        outcome.snr_db,
        outcome.snr_deviation_db,
        *outcome.snr_range_db,
    )


def rendered(held: Sequence[Held], data: str) -> str:
    """Return the page. `data`: the name of the recordings' folder."""
    done = frame(held, Held).filter(pl.col("rejected") == "", pl.col("furthest_percent").is_not_null())
    return page.render(
        "rate_control",
        globals(),
        data=data,
        recordings=len({row.recording for row in held}),
        command=shlex.join(["python", "-m", "studies.rate_control", *sys.argv[1:]]),
        furthest=as_rows(done.sort(_DEVIATION, descending=True))[0],
    )


def plot(path: Path, rows: pl.DataFrame) -> None:
    """Draw worst deviation, mean SNR and its mean deviation over the rates, a line for each codec. Raises OSError."""
    values = {
        "worst over 2 s, %": _DEVIATION.max(),
        "mean SNR, dB": pl.col("snr_db").mean(),
        "deviation of SNR, dB": pl.col("snr_deviation_db").mean(),
    }
    on_all = rows.filter(pl.len().over("codec", "bits_per_second") == rows["recording"].n_unique())
    table = on_all.group_by("codec", "bits_per_second", maintain_order=True).agg(**values).sort("bits_per_second")
    panels: list[Panel] = []
    for title in values:
        lines = [
            Curve(name, own["bits_per_second"].to_list(), own[title].to_list()) for (name,), own in by(table, "codec")
        ]
        limit = () if panels else (_LIMIT_PERCENT,)
        panels.append(Panel(title, "bit/s, frames included", "", lines, log_x=True, lines=limit))
    curves(path, panels, across=1)


if __name__ == "__main__":
    main()
