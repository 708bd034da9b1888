"""The results page, charts and tables; `python -m vibrocast.evaluation.results_page OUT` draws it again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click

from vibrocast import codec as codecs
from vibrocast.evaluation import charts, learned_page
from vibrocast.evaluation.bd_rate import (
    CONFIDENCE,
    ENOUGH_POINTS,
    MIN_OVERLAP,
    MIN_POINTS,
    SCALES,
    SNR,
    SPQI,
    ST_SIM_2800,
    ST_SIM_8000,
)
from vibrocast.evaluation.charts import name, size
from vibrocast.evaluation.comparison import (
    EQUAL_SNR_DB,
    LEARNED_SCALES,
    NEEDED_SNR_DB,
    TABLES,
    TIMES,
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
    cost_marks,
    curve_costs,
    excesses,
    mean_bd_rates,
    mean_curves,
    ratio_points,
    trace_bd_rates,
)
from vibrocast.evaluation.page_parts import (
    FEW_POINTS_MARK,
    bd_rate_text,
    chart,
    code,
    count,
    listed,
    number,
    paragraphs,
    table,
)
from vibrocast.evaluation.points import IMPORTED, MEASURED, PROGRAM, Failure, PointsError, read_rows, write_rows
from vibrocast.evaluation.speed import BITS_PER_SAMPLE, RATES, RATIO

RATE_SCALES = (SNR, ST_SIM_2800, ST_SIM_8000, SPQI)
COST_SCALES = (SNR, SPQI)
MAX_LISTED_FAILURES = 20
PAPER_CPU = "Intel Core i7-8700"
PAPER_SPEEDS = (("EVA (paper)", 24.99, 21.42), ("PVC-SLP (paper)", 7.14, 3.57))
"""Seconds per million samples at RATIO, encoding and decoding, as the EVA paper states them."""


@dataclass(frozen=True)
class Description:
    """What a run was: the name of its data, the class of machine that took the times, the command that repeats it."""

    data: str
    machine: str
    command: str


def write_results(
    out: Path,
    measurements: Measurements,
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
    makers: tuple[Callable[[], str], ...] = (
        partial(_head, measurements, description),
        *(
            partial(section, folder, measurements)
            for section in (
                learned_page.section,
                _advice_section,
                _rate_section,
                _ratio_section,
                _speed_section,
                partial(_cost_section, description.machine),
                _bd_rate_section,
                _excess_section,
            )
        ),
        partial(_failure_section, measurements),
        _files_section,
    )
    sections = []
    for place, make in enumerate(makers, 1):
        sections.append(make())
        progress(place / len(makers))
    (out / "results.md").write_text("\n\n".join(filter(None, sections)) + "\n", encoding="utf-8")


def _head(measurements: Measurements, description: Description) -> str:
    points = [point for by_trace in measurements.curves.values() for some in by_trace.values() for point in some]
    samples = sum({point.trace: point.samples for point in points}.values())
    rates = sorted({point.rate_hz for point in points if point.rate_hz is not None})
    at_rates = f" at {', '.join(f'{rate:g}' for rate in rates)} Hz" if rates else ""
    of_source: dict[str, list[str]] = {}
    for codec in measurements.curves:
        of_source.setdefault(measurements.source(codec), []).append(code(codec))
    parts = [
        "# Results",
        f"Data: {code(description.data)}, {count(len(measurements.traces), 'trace')}, {samples} samples{at_rates}. "
        f"Times: {description.machine}. Made by the command below, and drawn again from the CSV files in `results` by "
        "`python -m vibrocast.evaluation.results_page` with the folder of this page.",
        f"    {description.command}",
        "Sizes are of whole files, headers and tables included. SNR and PSNR are of the waveform, in dB; ST-SIM and "
        "SPQI weigh spectra against the threshold of touch, and are 1 for a copy. No one of them says all. No curve is "
        "drawn beyond its points; a mean is given only where a codec has a value on every trace.",
    ]
    if len(rates) > 1:
        parts.append(
            "The traces are of different rates, so bits per sample mean another thing on each, and some codecs may "
            "have no range in common: `--stream-rate-hz` codes all at one rate."
        )
    if unlike := [code(trace) for trace in measurements.traces if trace not in measurements.compared]:
        parts.append(f"Shorter than a block of ST-SIM, or without change, and so in no mean: {', '.join(unlike)}.")
    parts.append(_codec_list(measurements))
    if programs := of_source.get(PROGRAM):
        parts.append(
            f"Programs: codecs of the user's, run here: {', '.join(programs)}. Their times are wall-clock time with "
            "process start: an order of magnitude."
        )
    if imported := of_source.get(IMPORTED):
        parts.append(
            "Imported: figures that other programs reached on the same traces, taken from a table: "
            f"{', '.join(imported)}. Their times are wall-clock time with process start: an order of magnitude."
        )
    if measurements.failures:
        parts.append(f"**{count(len(measurements.failures), 'failure')}**, listed [below](#failures).")
    return paragraphs(*parts)


def _codec_list(measurements: Measurements) -> str:
    """Say what each measured codec is, all its sets of rate points and families of models in one line."""
    measured = [codec for codec in measurements.curves if measurements.source(codec) == MEASURED]
    lines = []
    for known in codecs.CODECS.values():
        if curves := [code(codec) for codec in measured if measurements.owner(codec) == known.name]:
            lines.append(f"- {', '.join(curves)}: {known.summary}")
    return "\n".join(lines)


def _advice_section(folder: Path, measurements: Measurements) -> str:
    rows = advice(measurements)
    write_rows(folder / "advice.csv", rows, Advice)
    ranking = ", ".join(
        f"{code(codec)} {bits:.2f}{' (imported)' * (measurements.source(codec) == IMPORTED)}"
        for codec, bits in bits_to_reach(measurements, NEEDED_SNR_DB).items()
    )
    return paragraphs(
        "## Which codec when",
        f"Mean bits per sample for {NEEDED_SNR_DB:g} dB SNR or more on every trace: {ranking or 'no codec does it'}.",
        "Chosen by rule among the codecs measured here that have a value on every trace. Beside each what it costs: "
        "mean bits, median times in seconds per million samples, delay, size of decoder and model.",
        table(
            ("if you need", "take", "bit/sample", "encode, s", "decode, s", "delay, ms", "code and model"),
            [
                (
                    row.need,
                    code(row.codec),
                    number(row.bits_per_sample),
                    number(row.encode_s_per_megasample),
                    number(row.decode_s_per_megasample),
                    number(row.delay_ms),
                    size(row.flash_bytes),
                )
                for row in rows
            ],
        ),
    )


def _rate_section(folder: Path, measurements: Measurements) -> str:
    anchors = measurements.anchors
    return paragraphs(
        "## Quality against rate",
        f"Means over the traces at equal rate: above what was measured, below in grey what is imported. Heavy: "
        f"{', '.join(map(code, anchors[:1]))}; shaded: from the 10th to the 90th percentile of the traces, of "
        f"{' and '.join(map(code, anchors[:2]))}; the band across: the window of BD-rate. A mark is a codec of one "
        "setting; on the edge, it lies beyond. The axes of ST-SIM and SPQI are spread towards 1.",
        *(
            chart(
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
    shown = list(dict.fromkeys([*measurements.anchors, *measurements.learned]))
    every_trace = [*measurements.learned[-1:], *reversed(measurements.anchors)][:2]
    return paragraphs(
        "## Quality against compression ratio",
        "The form of the EVA paper's Fig. 2 to 4, taken to be this: PSNR, ST-SIM and SPQI over the compression ratio "
        f"against 16 bits per sample, mean curves, and of {listed(list(map(code, every_trace)))} every trace's points. "
        f"Shown: {', '.join(map(code, shown))}; what is on the edge lies beyond. The peak of PSNR is the largest "
        "magnitude of the trace; the paper does not name its own.",
        chart(
            folder,
            "quality_against_ratio",
            ratio_points(measurements, LEARNED_SCALES),
            RatioPoint,
            partial(charts.plot_quality_against_ratio, scales=LEARNED_SCALES, every_trace=every_trace),
            "PSNR, ST-SIM and SPQI against compression ratio",
            shown,
        ),
    )


def _speed_section(folder: Path, measurements: Measurements) -> str:
    rates = listed([f"{rate:g}" for rate in RATES])
    return paragraphs(
        "## Speed against accuracy",
        f"Mean quality over the traces at {rates} bit/sample (compression ratios {16 / RATES[0]:g} and "
        f"{16 / RATES[-1]:.3g}) against what that costs: times of all traces coded as one signal at the setting "
        "nearest to that rate, processor time of one core without process start; of programs and those imported, "
        "medians over the traces of wall-clock time with process start. A trained model is there once for each "
        "runtime: the integer core, and ONNX Runtime. The line joins the codecs that no other measured one beats in "
        "both (Pareto front). Area of a mark: bytes of decoder and model; hollow: not known; diamond: imported; on the "
        "edge: the quality lies beyond, its value is written behind the name.",
        *(
            chart(
                folder,
                f"quality_against_{stem}_{scale.field}",
                cost_marks(measurements, scale, costs),
                Mark,
                partial(charts.plot_marks, scale=scale),
                f"{scale.label} at fixed rates against {words}",
                (),
            )
            for stem, words, costs in (
                ("time", "time", TIMES),
                ("delay", "delay and size", ("delay_ms", "flash_bytes")),
            )
            for scale in COST_SCALES
        ),
    )


def _bd_rate_section(folder: Path, measurements: Measurements) -> str:
    rows = trace_bd_rates(measurements)
    means = mean_bd_rates(rows, measurements.kind_of)
    write_rows(folder / "bd_rate_traces.csv", rows, TraceBdRate)
    write_rows(folder / "bd_rate.csv", means, MeanBdRate)
    windows = "; ".join(f"{scale.label} {scale.low:g} to {scale.high:g}" for scale in SCALES)
    parts = [
        "## BD-rate",
        "Bits relative to an anchor's at equal quality: -50 % is half the bits; mean over the traces. Of each trace by "
        f"pchip, with akima as a check, on the monotone envelopes of at least {MIN_POINTS} points each, over what both "
        f"cover of a fixed window ({windows}), if that is {MIN_OVERLAP:.0%} of it or more. The interval of the mean, "
        f"{CONFIDENCE:.0%}, is by bootstrap over the traces; after a mean in brackets the traces that could be "
        f"compared, where not all could. {FEW_POINTS_MARK} marks a mean with fewer than {ENOUGH_POINTS} points of a "
        "curve on some trace (column `points` of the files). Median, akima, spread at every quality, kinds of textures "
        "and what part of the window is covered: [bd_rate.csv](results/bd_rate.csv); each trace: "
        "[bd_rate_traces.csv](results/bd_rate_traces.csv).",
    ]
    for anchor in measurements.anchors:
        of_anchor = [row for row in means if row.anchor == anchor and not row.kind]
        parts += [f"### Relative to {code(anchor)}", _bd_rate_table(of_anchor, len(measurements.compared))]
        compared = {row.codec for row in of_anchor} | {anchor}
        if missing := [codec for codec in measurements.curves if codec not in compared]:
            parts.append(f"Too few points or too little in common on every trace: {', '.join(map(code, missing))}.")
    return paragraphs(*parts)


def _bd_rate_table(rows: Sequence[MeanBdRate], traces: int) -> str:
    by_codec = charts.by_codec(sorted(rows, key=lambda row: (row.quality != SNR.field, row.mean)))
    lines = []
    for of_codec in by_codec.values():
        found = {row.quality: row for row in of_codec}
        snr = found.get(SNR.field)
        lines.append(
            (
                name(of_codec[0]),
                *(_mean(found.get(scale.field), traces) for scale in SCALES[:1]),
                _interval(snr),
                f"{snr.lowest:+.1f} to {snr.highest:+.1f}" if snr else "",
                *(_mean(found.get(scale.field), traces) for scale in SCALES[1:]),
            )
        )
    names = [scale.label.split(",")[0] for scale in SCALES]
    return table(("codec", names[0], "interval", "lowest to highest", *names[1:]), lines)


def _mean(row: MeanBdRate | None, traces: int) -> str:
    if row is None:
        return ""
    return bd_rate_text(row) + (f" ({row.traces})" if row.traces < traces else "")


def _excess_section(folder: Path, measurements: Measurements) -> str:
    return paragraphs(
        "## Where each codec loses",
        f"Bits at {EQUAL_SNR_DB:g} dB SNR on each trace, in percent above those of the codec that needs the fewest "
        "there: 0 is the best of the row, 100 twice its bits, darker is more. Hatched: the codec lacks points on both "
        "sides of that SNR.",
        chart(
            folder,
            "excess_bits",
            excesses(measurements),
            Excess,
            charts.plot_excesses,
            f"Excess bits at {EQUAL_SNR_DB:g} dB SNR by trace and codec, in percent",
            measurements.curves,
        ),
    )


def _cost_section(machine: str, folder: Path, measurements: Measurements) -> str:
    rows = curve_costs(measurements)
    write_rows(folder / "curve_costs.csv", rows, CurveCost)
    return paragraphs(
        "## What each codec costs",
        f"Seconds per million samples near {BITS_PER_SAMPLE:g} bit/sample, compression ratio {RATIO:g}, taken as above "
        "at the setting nearest to it; what that took in bits stands beside. Real time: seconds of encoding and "
        "decoding for each second of one channel at the traces' rate. Memory: what coding 100 s adds to a process. "
        "Code and model: what a Cortex-M4 holds to decode, where that can be told; see [costs.csv](results/costs.csv).",
        f"Here: {machine}. The EVA paper's own figures, at the same ratio, are of an {PAPER_CPU} and other recordings, "
        "and how many cores worked is not known here: an order of magnitude beside these, not like for like.",
        table(
            ("codec", "bit/sample", "encode, s", "decode, s", "real time", "delay, ms", "memory", "code", "model"),
            [
                (
                    " ".join(filter(None, (name(row), row.runtime))),
                    *map(number, (row.bits_per_sample, row.encode_s_per_megasample, row.decode_s_per_megasample)),
                    *map(number, (row.real_time_factor, row.delay_ms)),
                    *map(size, (row.peak_memory_bytes, row.decoder_bytes, row.model_bytes)),
                )
                for row in rows
            ]
            + [
                (f"{codec}, {PAPER_CPU}", number(BITS_PER_SAMPLE), f"{encode_s:g}", f"{decode_s:g}", *[""] * 5)
                for codec, encode_s, decode_s in PAPER_SPEEDS
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
    return paragraphs(
        "## Failures",
        f"{count(len(measurements.failures), 'failure')}, all in [failures.csv](results/failures.csv). "
        "What failed has no point; without a codec, it is the trace that cannot be read."
        + (f" The first {MAX_LISTED_FAILURES} kinds:" if len(rows) > MAX_LISTED_FAILURES else "")
        if rows
        else "None.",
        table(("reason", "codec", "failures", "the first of them"), rows[:MAX_LISTED_FAILURES]),
    )


def _files_section() -> str:
    return paragraphs(
        "## Files",
        "All rows: [points.csv](results/points.csv) and the same as [JSON](results/points.json), "
        "[timings.csv](results/timings.csv), [speeds.csv](results/speeds.csv), [costs.csv](results/costs.csv), "
        "[kinds.csv](results/kinds.csv), [failures.csv](results/failures.csv).",
    )


def _interval(row: MeanBdRate | None) -> str:
    if row is None or row.interval_low is None or row.interval_high is None:
        return ""
    return f"{row.interval_low:+.1f} to {row.interval_high:+.1f}"


@click.command()
@click.argument("out", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(out: Path) -> None:
    """Draw the page OUT/results.md and its charts again, from the CSV files in OUT/results."""
    folder = out / "results"
    try:
        described = read_rows(folder / "description.csv", Description)
        if len(described) != 1:
            raise PointsError(f"{folder / 'description.csv'}: {len(described)} rows; it must have one")
        tables: dict[str, Any] = {name: read_rows(folder / f"{name}.csv", kind) for name, kind in TABLES.items()}
        write_results(out, Measurements(**tables), described[0])
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}; give the --out of a benchmark") from error
    except PointsError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
