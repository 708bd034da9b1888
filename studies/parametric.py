"""Compares parametric coding with waveform coding: `python -m studies.parametric FOLDER`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from studies import page
from studies.page import FOLDER, OUT, errors_in_one_line, results_folder, write_rows
from vibrocast import codec
from vibrocast.codec import CodedSignal, Setting
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.codec.metrics import Quality, measure
from vibrocast.files import atomic_write
from vibrocast.textures import Recording
from vibrocast.textures.dataset import entries, load, printable

DESCRIPTION, WAVEFORM = "parametric", "mdct"
RATES = (1, 10)
"""At how many times the description's rate the waveform is coded."""
MEASURES = {
    "third_octave_distance_db": "third-octave distance, dB",
    "log_spectral_distance_db": "log-spectral distance, dB",
    "spqi": "SPQI",
    "snr_db": "SNR, dB",
}


@dataclass(frozen=True)
class Row:
    """One trace coded once. `rate_point`: of the description's set of rate points. `bits_per_second`: of all packets,
    one channel.

    Qualities as in evaluation.metrics. A waveform is coded near the rate of the description of its rate point, or near
    ten times that, as `codec` says.
    """

    trace: str
    rate_point: str
    codec: str
    bits_per_second: float
    third_octave_distance_db: float | None
    log_spectral_distance_db: float | None
    spqi: float | None
    snr_db: float | None


def curve_name(times: int) -> str:
    """Return the name of a waveform at a multiple of the description's rate."""
    return f"{WAVEFORM}, {times} times the rate" if times > 1 else f"{WAVEFORM}, the same rate"


CURVES = (DESCRIPTION, *map(curve_name, RATES))


def rows_of(trace: str, recording: Recording) -> Iterator[Row]:
    """Yield what each setting of the description keeps of a recording, and waveforms of its rates. Raises CodecError.

    A rate that is below the least of the waveform codec has no row.
    """
    samples, rate_hz = recording.samples, round(recording.rate_hz)

    def row(rate_point: str, name: str, coded: CodedSignal) -> Row:
        quality = measure(samples, codec.decode(coded), rate_hz, recording.unit)
        values = {each: getattr(quality, each) for each in MEASURES}
        rounded = {each: None if value is None else round(value, 4) for each, value in values.items()}
        return Row(trace, rate_point, name, round(_bits_per_second(coded), 1), **rounded)

    for setting in codec.CODECS[DESCRIPTION].rate_point_sets[DESCRIPTION]:
        rate_point = _setting_text(setting)
        described = codec.encode(samples, rate_hz, setting, codec=DESCRIPTION, unit=recording.unit)
        yield row(rate_point, DESCRIPTION, described)
        for times in RATES:
            asked = times * _bits_per_second(described)
            try:
                source = codec.Source(samples, rate_hz, WAVEFORM, recording.unit)
                coded = codec.encode_to_rate(source, asked, _packet_bytes)
            except codec.TargetUnreachable:
                continue
            yield row(rate_point, curve_name(times), coded)


def _setting_text(setting: Setting) -> str:
    return " ".join(f"{name}={value}" for name, value in setting.items())


def _packet_bytes(coded: CodedSignal) -> int:
    return sum(map(len, coded.packets))


def _bits_per_second(coded: CodedSignal) -> float:
    return 8 * _packet_bytes(coded) * coded.rate_hz / coded.samples / coded.channels


def means(rows: Sequence[Row]) -> list[Row]:
    """Return the mean over the traces of each rate point and curve that all have; None where a trace has no value."""
    found = []
    traces = len({row.trace for row in rows})
    for rate_point in dict.fromkeys(row.rate_point for row in rows):
        for name in CURVES:
            some = [row for row in rows if (row.rate_point, row.codec) == (rate_point, name)]
            if len(some) == traces:
                values = {each: _mean([getattr(row, each) for row in some]) for each in MEASURES}
                found.append(Row("mean", rate_point, name, fmean(row.bits_per_second for row in some), **values))
    return found


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def write(out: Path, rows: Sequence[Row], data: str) -> None:
    """Write OUT/parametric.md, and its figures and chart in OUT/results. `data`: the folder's name. Raises OSError."""
    results = results_folder(out)
    write_rows(results / "parametric.csv", rows, Row)
    with atomic_write(results / "parametric.svg") as path:
        draw(path, means(rows))
    page.write(out / "parametric.md", _page(rows, data))


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw each measure over the rate, the description and the waveforms at both rates."""
    figure = Figure(figsize=(9, 3.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    shown = [name for name in MEASURES if name != "log_spectral_distance_db"]
    for axes, each in zip(figure.subplots(1, len(shown)), shown, strict=True):
        for name, marker, colour in ((DESCRIPTION, "o-", "#d55e00"), (WAVEFORM, "s:", "#0072b2")):
            curve = sorted((row.bits_per_second, getattr(row, each)) for row in rows if row.codec.startswith(name))
            axes.plot(*zip(*curve, strict=True), marker, color=colour, markersize=3, linewidth=1, label=name)
        axes.set_xscale("log")
        axes.set_xlabel("bit/s")
        axes.set_title(MEASURES[each], fontsize=9)
        axes.grid(color="0.85", linewidth=0.5)
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, format="svg", metadata={"Date": None})


def _page(rows: Sequence[Row], data: str) -> str:
    another_take, silence = _of_noise()
    settings: dict[str, list[dict[str, Any]]] = {}
    for row in means(rows):
        settings.setdefault(row.rate_point, []).append(vars(row))
    least, waveform_least = next(iter(settings.values()))[:2]
    return page.render(
        "parametric",
        description=DESCRIPTION,
        waveform=WAVEFORM,
        recordings=len({row.trace for row in rows}),
        data=data,
        rate_hz=DEFAULT_STREAM_RATE_HZ,
        settings=settings,
        least=least,
        waveform_least=waveform_least,
        measures=MEASURES,
        another_take=another_take,
        silence=silence,
    )


def _of_noise() -> tuple[Quality, Quality]:
    """Return how near another take of a steady noise is to it, and how near silence is."""
    generator = np.random.default_rng(1)
    noise, other = (generator.standard_normal((100_000, 1)) for _ in range(2))
    near, silent = (measure(noise, each, DEFAULT_STREAM_RATE_HZ) for each in (other, np.zeros_like(noise)))
    return near, silent


@click.command()
@FOLDER
@OUT
def main(folder: Path, out: Path) -> None:
    """Measure parametric coding on the recordings in FOLDER, and write parametric.md."""
    with errors_in_one_line():
        rows = [
            row
            for trace in entries(folder)
            for row in rows_of(trace.name, load(trace, stream_rate_hz=DEFAULT_STREAM_RATE_HZ))
        ]
        write(out, rows, printable(folder.name))
    click.echo(f"{out / 'parametric.md'}: {len({row.trace for row in rows})} recordings")


if __name__ == "__main__":
    main()
