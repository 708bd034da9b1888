"""The page of results: charts and tables of measured rows; `python -m evaluation.results_page OUT` draws it again."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click

import codec as codecs
from evaluation import charts
from evaluation.bd_rate import CONFIDENCE, MIN_OVERLAP, MIN_POINTS, PSNR, SCALES, SNR, SPQI, ST_SIM_2800, ST_SIM_8000
from evaluation.charts import CodecRow, name, size
from evaluation.comparison import (
    COSTED_RATE,
    EQUAL_SNR_DB,
    NEEDED_SNR_DB,
    RATES,
    Advice,
    CurveCost,
    Excess,
    Mark,
    MeanBdRate,
    MeanPoint,
    Measurements,
    RatioPoint,
    TraceBdRate,
    advice,
    bits_to_reach,
    curve_costs,
    delay_marks,
    excesses,
    mean_bd_rates,
    mean_curves,
    ratio_points,
    time_marks,
    trace_bd_rates,
)
from evaluation.cost import CodecCost
from evaluation.points import IMPORTED, MEASURED, PROGRAM, Failure, Point, PointsError, Timing, read_rows, write_rows

RATE_SCALES = (SNR, ST_SIM_2800, ST_SIM_8000, SPQI)
RATIO_SCALES = (PSNR, ST_SIM_2800)
COST_SCALES = (SNR, SPQI)
MAX_LISTED_FAILURES = 20


@dataclass(frozen=True)
class Description:
    """What a run was: the name of its data, the class of machine that took the times, the command that repeats it."""

    data: str
    machine: str
    command: str


def write_results(
    out: Path,
    points: Sequence[Point],
    timings: Sequence[Timing],
    costs: Sequence[CodecCost],
    failures: Sequence[Failure],
    description: Description,
    progress: Callable[[float], object] = lambda part: None,
) -> None:
    """Write OUT/results.md and, in OUT/results, its charts and tables, each with its data as CSV, and the description.

    Imported points count where no codec of that name was measured, on the traces that were. `progress` is called with
    the part done, from 0 to 1. Raises OSError where a file cannot be written.
    """
    folder = out / "results"
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(folder / "description.csv", [description], Description)
    measurements = Measurements(points, timings, costs, failures)
    makers: tuple[Callable[[], str], ...] = (
        partial(_head, measurements, description),
        *(
            partial(section, folder, measurements)
            for section in (
                _advice_section,
                _rate_section,
                _ratio_section,
                _time_section,
                _delay_section,
                _bd_rate_section,
                _excess_section,
                _cost_section,
            )
        ),
        partial(_failure_section, measurements),
        _files_section,
    )
    sections = []
    for number, make in enumerate(makers, 1):
        sections.append(make())
        progress(number / len(makers))
    (out / "results.md").write_text("\n\n".join(sections) + "\n", encoding="utf-8")


def _head(measurements: Measurements, description: Description) -> str:
    points = [point for by_trace in measurements.curves.values() for some in by_trace.values() for point in some]
    samples = sum({point.trace: point.samples for point in points}.values())
    rates = sorted({point.rate_hz for point in points if point.rate_hz is not None})
    at_rates = f" at {', '.join(f'{rate:g}' for rate in rates)} Hz" if rates else ""
    of_source: dict[str, list[str]] = {}
    for codec in measurements.curves:
        of_source.setdefault(measurements.source(codec), []).append(_code(codec))
    paragraphs = [
        "# Results",
        f"Data: {_code(description.data)}, {_count(len(measurements.traces), 'trace')}, {samples} samples{at_rates}. "
        f"Times: {description.machine}. Made by the command below, and drawn again from the CSV files in `results` by "
        "`python -m evaluation.results_page` with the folder of this page.",
        f"    {description.command}",
        "Sizes are of whole files, headers and tables included. SNR and PSNR are of the waveform, in dB; ST-SIM and "
        "SPQI weigh spectra against the threshold of touch, and are 1 for a copy. No one of them says all. No curve is "
        "drawn beyond its points; a mean is given only where a codec has a value on every trace.",
    ]
    if len(rates) > 1:
        paragraphs.append(
            "The traces are of different rates, so bits per sample mean another thing on each, and some codecs may "
            "have no range in common: `--stream-rate-hz` codes all at one rate."
        )
    if unlike := [_code(trace) for trace in measurements.traces if trace not in measurements.compared]:
        paragraphs.append(f"Shorter than a block of ST-SIM, or without change, and so in no mean: {', '.join(unlike)}.")
    paragraphs.append(_codec_list(measurements))
    if programs := of_source.get(PROGRAM):
        paragraphs.append(
            f"Programs: codecs of the user's, run here: {', '.join(programs)}. Their times are wall-clock time with "
            "process start: an order of magnitude."
        )
    if imported := of_source.get(IMPORTED):
        paragraphs.append(
            "Imported: figures that other programs reached on the same traces, taken from a table: "
            f"{', '.join(imported)}. Their times are wall-clock time with process start: an order of magnitude."
        )
    if measurements.failures:
        paragraphs.append(f"**{_count(len(measurements.failures), 'failure')}**, listed [below](#failures).")
    return _paragraphs(*paragraphs)


def _codec_list(measurements: Measurements) -> str:
    """Say what each measured codec is, all its ladders in one line."""
    measured = [codec for codec in measurements.curves if measurements.source(codec) == MEASURED]
    lines = []
    for known in codecs.CODECS.values():
        if ladders := [_code(codec) for codec in measured if codec in known.ladders]:
            lines.append(f"- {', '.join(ladders)}: {known.summary}")
    return "\n".join(lines)


def _advice_section(folder: Path, measurements: Measurements) -> str:
    rows = advice(measurements)
    write_rows(folder / "advice.csv", rows, Advice)
    ranking = ", ".join(
        f"{_code(codec)} {bits:.2f}{' (imported)' * (measurements.source(codec) == IMPORTED)}"
        for codec, bits in bits_to_reach(measurements, NEEDED_SNR_DB).items()
    )
    return _paragraphs(
        "## Which codec when",
        f"Mean bits per sample for {NEEDED_SNR_DB:g} dB SNR or more on every trace: {ranking or 'no codec does it'}.",
        "Chosen by rule among the codecs measured here that have a value on every trace. Beside each what it costs: "
        "mean bits, median times in seconds per million samples, delay, size of the decoder.",
        _table(
            ("if you need", "take", "bit/sample", "encode, s", "decode, s", "delay, ms", "decoder"),
            [
                (
                    row.need,
                    _code(row.codec),
                    _number(row.bits_per_sample),
                    _number(row.encode_s_per_megasample),
                    _number(row.decode_s_per_megasample),
                    _number(row.delay_ms),
                    size(row.decoder_bytes),
                )
                for row in rows
            ],
        ),
    )


def _rate_section(folder: Path, measurements: Measurements) -> str:
    anchors = measurements.anchors
    return _paragraphs(
        "## Quality against rate",
        f"Means over the traces at equal rate: above what was measured, below in grey what is imported. Heavy: "
        f"{', '.join(map(_code, anchors[:1]))}; shaded: from the 10th to the 90th percentile of the traces, of "
        f"{' and '.join(map(_code, anchors[:2]))}; the band across: the window of BD-rate. A mark is a codec of one "
        "setting; on the edge, it lies beyond. The axes of ST-SIM and SPQI are spread towards 1.",
        *(
            _chart(
                folder,
                f"quality_against_rate_{scale.field}",
                mean_curves(measurements, scale),
                MeanPoint,
                partial(charts.plot_quality_against_rate, scale=scale, main=anchors[:2]),
                f"{scale.label} against bits per sample",
                measurements.curves,
            )
            for scale in RATE_SCALES
        ),
    )


def _ratio_section(folder: Path, measurements: Measurements) -> str:
    return _paragraphs(
        "## Every trace, against compression ratio",
        "The form of the EVA paper's Fig. 3, taken to be this: each trace's points and the mean curve of each codec, "
        f"PSNR and ST-SIM over the compression ratio. Shown: {', '.join(map(_code, measurements.anchors))}; what is on "
        "the edge lies beyond. The peak of PSNR is the largest magnitude of the trace; the paper does not name its "
        "own.",
        _chart(
            folder,
            "quality_against_ratio",
            ratio_points(measurements, RATIO_SCALES),
            RatioPoint,
            partial(charts.plot_quality_against_ratio, scales=RATIO_SCALES),
            "PSNR and ST-SIM of every trace against compression ratio",
            measurements.anchors,
        ),
    )


def _time_section(folder: Path, measurements: Measurements) -> str:
    return _paragraphs(
        "## Quality against time",
        f"At {_rates()} bit/sample: mean quality over the traces, median time at the setting nearest to that rate. "
        "Processor time of one core without process start; of programs and those imported, wall-clock time with "
        "process start. The line joins the codecs that no other measured one beats in both (Pareto front). Area of a "
        "mark: bytes of the decoder; hollow: not known; diamond: imported.",
        *(
            _chart(
                folder,
                f"quality_against_time_{scale.field}",
                time_marks(measurements, scale),
                Mark,
                partial(charts.plot_marks, scale=scale),
                f"{scale.label} at fixed rates against time",
                measurements.curves,
            )
            for scale in COST_SCALES
        ),
    )


def _delay_section(folder: Path, measurements: Measurements) -> str:
    return _paragraphs(
        "## Quality against delay",
        f"At {_rates()} bit/sample: mean quality over the traces against algorithmic delay. Line and marks as above.",
        *(
            _chart(
                folder,
                f"quality_against_delay_{scale.field}",
                delay_marks(measurements, scale),
                Mark,
                partial(charts.plot_marks, scale=scale),
                f"{scale.label} at fixed rates against delay",
                measurements.curves,
            )
            for scale in COST_SCALES
        ),
    )


def _bd_rate_section(folder: Path, measurements: Measurements) -> str:
    rows = trace_bd_rates(measurements)
    means = mean_bd_rates(rows)
    write_rows(folder / "bd_rate_traces.csv", rows, TraceBdRate)
    write_rows(folder / "bd_rate.csv", means, MeanBdRate)
    windows = "; ".join(f"{scale.label} {scale.low:g} to {scale.high:g}" for scale in SCALES)
    parts = [
        "## BD-rate",
        "Bits relative to an anchor's at equal quality: -50 % is half the bits. Of each trace by pchip, with akima as "
        f"a check, on the monotone envelopes of at least {MIN_POINTS} points each, over what both cover of a fixed "
        f"window ({windows}), if that is {MIN_OVERLAP:.0%} of it or more. The interval of the mean, "
        f"{CONFIDENCE:.0%}, is by bootstrap over the traces. `whole` counts the traces on which the whole window is "
        "covered.",
    ]
    for anchor in measurements.anchors:
        parts.append(f"### Relative to {_code(anchor)}")
        for scale in SCALES:
            of_scale = [row for row in means if (row.anchor, row.quality) == (anchor, scale.field)]
            if of_scale:
                parts += [
                    f"<details{' open' * (scale == SNR)}><summary>At equal {scale.label.split(',')[0]}</summary>",
                    _bd_rate_table(of_scale),
                    "</details>",
                ]
        compared = {row.codec for row in means if row.anchor == anchor} | {anchor}
        if missing := [codec for codec in measurements.curves if codec not in compared]:
            parts.append(f"Too few points or too little in common on every trace: {', '.join(map(_code, missing))}.")
    parts.append(
        "Data: [bd_rate.csv](results/bd_rate.csv), and of each trace [bd_rate_traces.csv](results/bd_rate_traces.csv)."
    )
    return _paragraphs(*parts)


def _bd_rate_table(rows: Sequence[MeanBdRate]) -> str:
    return _table(
        ("codec", "mean", "interval", "median", "lowest", "highest", "akima", "traces", "compared over", "whole"),
        [
            (
                name(row),
                _percent(row.mean),
                _interval(row),
                *map(_percent, (row.median, row.lowest, row.highest, row.akima_mean)),
                str(row.traces),
                f"{row.low:.3g} to {row.high:.3g}",
                str(row.whole_window_traces),
            )
            for row in rows
        ],
    )


def _excess_section(folder: Path, measurements: Measurements) -> str:
    return _paragraphs(
        "## Where each codec loses",
        f"Bits at {EQUAL_SNR_DB:g} dB SNR on each trace, in percent above those of the codec that needs the fewest "
        "there: 0 is the best of the row, 100 twice its bits, darker is more. Hatched: the codec lacks points on both "
        "sides of that SNR.",
        _chart(
            folder,
            "excess_bits",
            excesses(measurements),
            Excess,
            charts.plot_excesses,
            f"Excess bits at {EQUAL_SNR_DB:g} dB SNR by trace and codec, in percent",
            measurements.curves,
        ),
    )


def _cost_section(folder: Path, measurements: Measurements) -> str:
    rows = curve_costs(measurements)
    write_rows(folder / "curve_costs.csv", rows, CurveCost)
    return _paragraphs(
        "## What each codec costs",
        f"Times in seconds per million samples: medians over the traces at the setting nearest to {COSTED_RATE:g} "
        "bit/sample. Real time: seconds of encoding and decoding for each second of one channel at the traces' rate. "
        "Settings: how many were measured. What the decoder's bytes count is in [costs.csv](results/costs.csv).",
        _table(
            ("codec", "settings", "encode, s", "decode, s", "real time", "delay, ms", "memory", "decoder"),
            [
                (
                    name(row),
                    str(row.settings),
                    *map(_number, (row.encode_s_per_megasample, row.decode_s_per_megasample, row.real_time_factor)),
                    _number(row.delay_ms),
                    size(row.peak_memory_bytes),
                    size(row.decoder_bytes),
                )
                for row in rows
            ],
        ),
        "Data: [curve_costs.csv](results/curve_costs.csv).",
    )


def _failure_section(measurements: Measurements) -> str:
    groups: dict[tuple[str, str], list[Failure]] = {}
    for failure in measurements.failures:
        groups.setdefault((failure.codec, failure.reason), []).append(failure)
    rows = [
        (reason, codec, str(len(failures)), " ".join(filter(None, (failures[0].trace, failures[0].setting))))
        for (codec, reason), failures in groups.items()
    ]
    return _paragraphs(
        "## Failures",
        f"{_count(len(measurements.failures), 'failure')}, all in [failures.csv](results/failures.csv). "
        "What failed has no point; without a codec, it is the trace that cannot be read."
        + (f" The first {MAX_LISTED_FAILURES} kinds:" if len(rows) > MAX_LISTED_FAILURES else "")
        if rows
        else "None.",
        _table(("reason", "codec", "failures", "the first of them"), rows[:MAX_LISTED_FAILURES]),
    )


def _files_section() -> str:
    return _paragraphs(
        "## Files",
        "All rows: [points.csv](results/points.csv) and the same as [JSON](results/points.json), "
        "[timings.csv](results/timings.csv), [costs.csv](results/costs.csv), [failures.csv](results/failures.csv).",
    )


def _chart(
    folder: Path,
    stem: str,
    rows: Sequence[CodecRow],
    kind: type[CodecRow],
    plot: Callable[[Path, Sequence[CodecRow]], None],
    title: str,
    expected: Iterable[str],
) -> str:
    """Write a chart and its data, and return its place on the page; without data only that there is none."""
    image = folder / f"{stem}.png"
    write_rows(folder / f"{stem}.csv", rows, kind)
    if not rows:
        image.unlink(missing_ok=True)
        return f"{title}: no codec has the values."
    plot(image, rows)
    drawn = {row.codec for row in rows}
    missing = [_code(codec) for codec in expected if codec not in drawn]
    return _paragraphs(
        f"![{title}](results/{stem}.png)",
        f"*{title}; data: [{stem}.csv](results/{stem}.csv).*"
        + (f" Without the values on every trace, and not drawn: {', '.join(missing)}." if missing else ""),
    )


def _paragraphs(*parts: str) -> str:
    return "\n\n".join(part for part in parts if part)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table, its first column to the left; without rows, nothing."""
    if not rows:
        return ""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *([_text(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _text(cell: str) -> str:
    """Return text that a Markdown table shows as it is."""
    return " ".join(cell.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").split())


def _code(text: str) -> str:
    return f"`{text.replace('`', '')}`"


def _count(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _percent(value: float) -> str:
    return f"{value:+.1f} %"


def _interval(row: MeanBdRate) -> str:
    if row.interval_low is None or row.interval_high is None:
        return ""
    return f"{row.interval_low:+.1f} to {row.interval_high:+.1f}"


def _rates() -> str:
    *others, last = (f"{rate:g}" for rate in RATES)
    return f"{', '.join(others)} and {last}"


@click.command()
@click.argument("out", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(out: Path) -> None:
    """Draw the page OUT/results.md and its charts again, from the CSV files in OUT/results."""
    folder = out / "results"
    try:
        described = read_rows(folder / "description.csv", Description)
        if len(described) != 1:
            raise PointsError(f"{folder / 'description.csv'}: {len(described)} rows; it must have one")
        write_results(
            out,
            read_rows(folder / "points.csv", Point),
            read_rows(folder / "timings.csv", Timing),
            read_rows(folder / "costs.csv", CodecCost),
            read_rows(folder / "failures.csv", Failure),
            described[0],
        )
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}; give the --out of a benchmark") from error
    except PointsError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
