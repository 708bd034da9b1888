"""Codes every WAV file of a folder at many step sizes and compares rate and SNR with peers, in tables and charts."""

import json
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

import click
from rich.console import Console
from rich.progress import track
from rich.table import Table

import codec
from evaluation.bd_rate import WINDOW_DB, BdRate, bd_rates, summary
from evaluation.charts import plot_mean, plot_traces
from evaluation.points import Point, PointsError, by_codec_and_trace, read_points, write_rows
from host import coding
from textures import TextureError, load

# Quantiser steps relative to the RMS value: from some 2 dB of SNR to some 27.
STEPS = tuple(2 ** (exponent / 2) for exponent in range(4, -8, -1))

BdRates = dict[str, dict[str, BdRate]]


def measure(path: Path, codec_name: str, step: float) -> Point:
    """Code one WAV file into a .vct file, read that back and decode it; return its size and SNR.

    Raises TextureError or CodecError on a file that cannot be coded.
    """
    recording = load(path)
    coded = codec.encode(recording.samples, round(recording.rate_hz), {"step": step}, codec=codec_name)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "coded.vct"
        coding.write(file, coding.as_stream(coded, recording.unit))
        size_bytes = file.stat().st_size
        decoded = coding.read(file).decode()
    reached_db = codec.snr_db(recording.samples, decoded)
    if reached_db is None:
        raise codec.CodecError(f"{path} is silent and has no SNR; leave it out")
    return Point(path.stem, codec_name, f"step {step:.4f}", recording.samples.size, size_bytes, round(reached_db, 4))


def measure_all(paths: list[Path], codec_name: str) -> list[Point]:
    """Return the points of every file at every one of STEPS, measured on all cores, with a progress bar."""
    tasks = [(path, codec_name, step) for path in paths for step in STEPS]
    with ProcessPoolExecutor() as workers:
        futures = [workers.submit(measure, *task) for task in tasks]
        for _ in track(as_completed(futures), "coding", len(futures), console=Console(stderr=True)):
            pass
    return [future.result() for future in futures]


def compare(points: list[Point], peers: list[Point], codec_name: str) -> BdRates:
    """Return the BD-rates of the codec relative to every peer that shares enough of a trace, by peer and trace."""
    ours = by_codec_and_trace(points)[codec_name]
    rates = {peer: bd_rates(curves, ours) for peer, curves in by_codec_and_trace(peers).items()}
    return {peer: by_trace for peer, by_trace in rates.items() if by_trace}


def table_rows(rates: BdRates) -> list[tuple[str, ...]]:
    """Return one row of text for each peer: mean, median, lowest and highest BD-rate, the check, traces, window."""
    rows = []
    for peer, by_trace in rates.items():
        entire = summary(list(by_trace.values()))
        low_db = min(rate.low_db for rate in by_trace.values())
        high_db = max(rate.high_db for rate in by_trace.values())
        percents = (entire.mean, entire.median, entire.lowest, entire.highest, entire.akima_mean)
        figures = [f"{percent:+.1f} %" for percent in percents]
        rows.append((peer, *figures, str(entire.traces), f"{low_db:.1f} to {high_db:.1f} dB"))
    return sorted(rows, key=lambda row: summary(list(rates[row[0]].values())).mean)


TABLE_HEADER = ("peer", "mean", "median", "lowest", "highest", "mean by akima", "traces", "SNR compared")


def markdown(codec_name: str, rows: list[tuple[str, ...]], folder: str, traces: int) -> str:
    """Return the page that holds the table and the charts."""
    lines = [
        f"# Rate and distortion of `{codec_name}`",
        "",
        f"Written by `python -m evaluation.rate_distortion`. BD-rate on the {traces} traces of `{folder}`: bits of the",
        "whole file relative to the peer's at equal SNR, by pchip on the monotone envelope of at least 6 points, over",
        f"{WINDOW_DB[0]:g} to {WINDOW_DB[1]:g} dB where both have points; -50 % is half the bits. Peers that shape",
        "their noise for perception get no credit for it here.",
        "",
        f"| {' | '.join(TABLE_HEADER)} |",
        "|---" + "|---:" * (len(TABLE_HEADER) - 1) + "|",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        "![Mean over the traces](rate_distortion.png)",
        "",
        "![Each trace](rate_distortion_traces.png)",
        "",
        "Raw points: `rate_distortion_points.csv`; BD-rates of each trace: `rate_distortion.json`.",
        "",
    ]
    return "\n".join(lines)


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--peers", type=click.Path(exists=True, dir_okay=False, path_type=Path), required=True, help="CSV of points."
)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default="docs/results", show_default=True)
@click.option("--codec", "codec_name", type=click.Choice(sorted(codec.CODECS)), default="mdct", show_default=True)
def main(folder: Path, peers: Path, out: Path, codec_name: str) -> None:
    """Code every WAV file in FOLDER at many step sizes; write points, BD-rates against the peers, and charts."""
    paths = sorted(folder.glob("*.wav"))
    if not paths:
        raise click.ClickException(f"{folder}: no WAV files")
    try:
        peer_points = read_points(peers)
        points = measure_all(paths, codec_name)
        out.mkdir(parents=True, exist_ok=True)
        write_rows(out / "rate_distortion_points.csv", points, Point)
    except (PointsError, TextureError, codec.CodecError, OSError) as error:
        raise click.ClickException(str(error)) from error
    rates = compare(points, peer_points, codec_name)
    rows = table_rows(rates)
    record = {
        "codec": codec_name,
        "window_db": WINDOW_DB,
        "bd_rate": {
            peer: {trace: asdict(rate) for trace, rate in by_trace.items()} for peer, by_trace in rates.items()
        },
        "summary": {peer: asdict(summary(list(by_trace.values()))) for peer, by_trace in rates.items()},
        "points": [asdict(point) for point in points],
    }
    (out / "rate_distortion.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    (out / "rate_distortion.md").write_text(
        markdown(codec_name, rows, folder.resolve().name, len(paths)), encoding="utf-8"
    )
    curves = by_codec_and_trace([*points, *(point for point in peer_points if point.codec in rates)])
    plot_mean(out / "rate_distortion.png", curves, codec_name)
    plot_traces(out / "rate_distortion_traces.png", curves, codec_name)
    table = Table(*TABLE_HEADER, title=f"BD-rate of {codec_name}, {len(paths)} traces")
    for row in rows:
        table.add_row(*row)
    Console(width=max(Console().width, 110)).print(table)  # narrower, the columns cannot be read


if __name__ == "__main__":
    main()
