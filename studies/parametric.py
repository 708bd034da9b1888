"""Compares parametric coding with waveform coding: `python -m studies.parametric FOLDER`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vibrocast import codec
from vibrocast.codec import CodedSignal, Setting
from vibrocast.codec.encoding import DEFAULT_STREAM_RATE_HZ
from vibrocast.evaluation.metrics import Quality, measure
from vibrocast.evaluation.page_parts import code, count, number, paragraphs, table
from vibrocast.evaluation.points import write_rows
from vibrocast.files import atomic_write
from vibrocast.textures import Recording, TextureError
from vibrocast.textures.dataset import DatasetError, load, printable, traces

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
    """Return what a waveform at so many times the description's rate is called."""
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
    results = out / "results"
    results.mkdir(parents=True, exist_ok=True)
    with atomic_write(results / "parametric.csv") as path:
        write_rows(path, rows, Row)
    with atomic_write(results / "parametric.png") as path:
        draw(path, means(rows))
    with atomic_write(out / "parametric.md") as path:
        path.write_text(_page(rows, data) + "\n", encoding="utf-8")


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw each measure over the rate, the description and the waveforms at both rates."""
    figure = Figure(figsize=(9, 3.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    shown = [name for name in MEASURES if name != "log_spectral_distance_db"]
    for axes, each in zip(figure.subplots(1, len(shown)), shown, strict=True):
        for name, marker in ((DESCRIPTION, "o-"), (WAVEFORM, "s:")):
            curve = sorted((row.bits_per_second, getattr(row, each)) for row in rows if row.codec.startswith(name))
            axes.plot(*zip(*curve, strict=True), marker, color="black", markersize=3, linewidth=1, label=name)
        axes.set_xscale("log")
        axes.set_xlabel("bit/s")
        axes.set_title(MEASURES[each], fontsize=9)
        axes.grid(color="0.85", linewidth=0.5)
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, format="png")


def _page(rows: Sequence[Row], data: str) -> str:
    recordings = len({row.trace for row in rows})
    another_take, silence = _of_noise()
    return paragraphs(
        "# A description instead of a waveform",
        f"What {code(DESCRIPTION)} keeps of {count(recordings, 'recording')}, beside {code(WAVEFORM)} at the same rate "
        "and at ten times that. Written by",
        f"    python -m studies.parametric {data} --out docs",
        f"with a folder of recordings, resampled to {DEFAULT_STREAM_RATE_HZ} Hz. Rates are of all packets, without the "
        "file's header and the framing of its packets, which are alike. Means over the recordings, where all have a "
        "value; each by itself is in [parametric.csv](results/parametric.csv). Measures: [metrics.md](metrics.md).",
        *(
            _rate_point_section(place, rate_point, rows)
            for place, rate_point in enumerate(dict.fromkeys(row.rate_point for row in rows), 1)
        ),
        "![third-octave distance, SPQI and SNR over the rate](results/parametric.png)",
        "How to read it:",
        f"- Two takes of one steady noise are {number(another_take.third_octave_distance_db)} dB apart in third "
        "octaves, in frames of 0.1 s. What is that near can be another take; only what is said of the course of the "
        "levels brings a description nearer.",
        f"- SPQI compares bins of 2.7 Hz, and gives another take of that noise {number(another_take.spqi)}, less than "
        f"silence, {number(silence.spqi)}: it cannot judge a description.",
        "- SNR: of a signal as strong as the recording, and otherwise independent of it, it is -3 dB.",
    )


def _rate_point_section(place: int, rate_point: str, rows: Sequence[Row]) -> str:
    header = ("", "bit/s", *MEASURES.values())
    cells = [
        (code(row.codec), f"{row.bits_per_second:.0f}", *(number(getattr(row, each)) for each in MEASURES))
        for row in means(rows)
        if row.rate_point == rate_point
    ]
    return paragraphs(f"## Setting {place}", code(rate_point), table(header, cells))


def _of_noise() -> tuple[Quality, Quality]:
    """Return how near another take of a steady noise is to it, and how near silence is."""
    generator = np.random.default_rng(1)
    noise, other = (generator.standard_normal((100_000, 1)) for _ in range(2))
    near, silent = (measure(noise, each, DEFAULT_STREAM_RATE_HZ) for each in (other, np.zeros_like(noise)))
    return near, silent


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder for parametric.md."
)
def main(folder: Path, out: Path) -> None:
    """Measure what a description keeps of the recordings in FOLDER and write the page OUT/parametric.md."""
    try:
        rows = [
            row
            for trace in traces(folder)
            for row in rows_of(trace.name, load(trace, stream_rate_hz=DEFAULT_STREAM_RATE_HZ))
        ]
        write(out, rows, printable(folder.name))
    except (TextureError, DatasetError, codec.CodecError) as error:
        raise click.ClickException(str(error)) from error
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}") from error
    click.echo(f"{out / 'parametric.md'}: {len({row.trace for row in rows})} recordings")


if __name__ == "__main__":
    main()
