"""The results page, charts and tables; `python -m vibrocast.evaluation.results_page OUT` draws it again."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
import polars as pl

from vibrocast import codec as codecs
from vibrocast import pages
from vibrocast.evaluation import bd_rate, charts, comparison, learned_page, speed
from vibrocast.evaluation.bd_rate import SCALES, SNR, SPQI, ST_SIM_2800, ST_SIM_8000
from vibrocast.evaluation.comparison import LEARNED_SCALES, PAPER_SCALES, TABLES, TIMES, Measurements
from vibrocast.evaluation.points import (
    IMPORTED,
    MEASURED,
    PROGRAM,
    Failure,
    PointsError,
    read_rows,
    write_rows,
)
from vibrocast.evaluation.tables import as_rows, write_table

NOTE = "note.md"
"""In OUT/results: what the page says of its data before all else, in Markdown, if a person has put it there."""
TEMPLATE = Path(__file__).with_name("results.md.jinja")
RATE_SCALES = (SNR, ST_SIM_2800, ST_SIM_8000, SPQI)
COST_SCALES = (SNR, SPQI)
MAX_LISTED_FAILURES = 20
RULES = {
    "bits_per_sample": speed.BITS_PER_SAMPLE,
    "confidence": bd_rate.CONFIDENCE,
    "enough_points": bd_rate.ENOUGH_POINTS,
    "equal_snr_db": comparison.EQUAL_SNR_DB,
    "max_ratio": comparison.MAX_RATIO,
    "min_overlap": bd_rate.MIN_OVERLAP,
    "min_points": bd_rate.MIN_POINTS,
    "min_ratio": comparison.MIN_RATIO,
    "needed_snr_db": comparison.NEEDED_SNR_DB,
    "rates": speed.RATES,
    "ratio": speed.RATIO,
}
"""Figures that the page's words state."""


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
    parts: dict[str, Callable[[], Any]] = {
        "learned": partial(learned_page.section, folder, measurements),
        "recommendations": partial(_written, folder / "advice.csv", comparison.recommendations, measurements),
        "charts": partial(_charts, folder, measurements),
        "costs": partial(_written, folder / "curve_costs.csv", comparison.curve_costs, measurements),
        "bd_rates": partial(_bd_rates, folder, measurements),
    }
    values = {}
    for place, (name, make) in enumerate(parts.items(), 1):
        values[name] = make()
        progress(place / len(parts))
    page = pages.render(
        TEMPLATE,
        **_head(folder, measurements),
        **values,
        description=description,
        measurements=measurements,
        name=charts.name,
    )
    (out / "results.md").write_text(page, encoding="utf-8")


def _head(folder: Path, measurements: Measurements) -> dict[str, Any]:
    """Return what the page says besides tables and charts."""
    of_source: dict[str, list[str]] = {source: [] for source in (MEASURED, PROGRAM, IMPORTED)}
    for codec in measurements.curves:
        of_source[measurements.source(codec)].append(codec)
    summaries = []
    for known in codecs.CODECS.values():
        if curves := [codec for codec in of_source[MEASURED] if measurements.owner(codec) == known.name]:
            summaries.append((curves, known.summary))
    failures: dict[tuple[str, str], list[Failure]] = {}
    for failure in measurements.failures:
        failures.setdefault((failure.codec, failure.reason), []).append(failure)
    return {
        "samples": measurements.drawn.unique("trace", keep="last")["samples"].sum(),
        "rates_hz": sorted(measurements.drawn["rate_hz"].drop_nulls().unique()),
        "left_out": [trace for trace in measurements.traces if trace not in measurements.compared],
        "codecs": summaries,
        "programs": of_source[PROGRAM],
        "imported": of_source[IMPORTED],
        "ranking": comparison.bits_to_reach(measurements, comparison.NEEDED_SNR_DB),
        "note": note.read_text(encoding="utf-8").strip() if (note := folder / NOTE).exists() else "",
        "failures": [(*kind, some) for kind, some in failures.items()],
        "max_listed_failures": MAX_LISTED_FAILURES,
        "scales": SCALES,
        "paper_scales": PAPER_SCALES,
        "rules": RULES,
    }


def _written(path: Path, make: Callable[[Measurements], pl.DataFrame], measurements: Measurements) -> list[Any]:
    table = make(measurements)
    write_table(path, table)
    return as_rows(table)


def _charts(folder: Path, measurements: Measurements) -> dict[str, Any]:
    main = measurements.anchors[:2]
    rate = [
        charts.Chart(
            f"quality_against_rate_{scale.field}",
            f"{scale.label} against bits per sample",
            comparison.mean_curves(measurements, scale),
            tuple(measurements.curves),
        ).write(folder, partial(charts.plot_quality_against_rate, scale=scale, main=main))
        for scale in RATE_SCALES
    ]
    pair = tuple(measurements.paper_pair)
    ratio = charts.Chart(
        "quality_against_ratio",
        "PSNR, ST-SIM and SPQI against compression ratio",
        comparison.ratio_points(measurements, LEARNED_SCALES),
        pair,
    ).write(folder, partial(charts.plot_quality_against_ratio, scales=LEARNED_SCALES))
    regions = charts.Chart(
        "bd_regions",
        "Where BD-rate integrates",
        comparison.bd_regions(measurements, PAPER_SCALES),
        pair,
    ).write(folder, partial(charts.plot_bd_regions, scales=PAPER_SCALES))
    cost = [
        charts.Chart(
            f"quality_against_{stem}_{scale.field}",
            f"{scale.label} at fixed rates against {words}",
            comparison.cost_points(measurements, scale, costs),
        ).write(folder, partial(charts.plot_cost_points, scale=scale))
        for stem, words, costs in (
            ("time", "time", TIMES),
            ("delay", "delay and size", ("delay_ms", "flash_bytes")),
        )
        for scale in COST_SCALES
    ]
    excess = charts.Chart(
        "excess_bits",
        f"Excess bits at {comparison.EQUAL_SNR_DB:g} dB SNR by trace and codec, in percent",
        comparison.rate_excesses(measurements),
        tuple(measurements.curves),
    ).write(folder, charts.plot_rate_excesses)
    return {"rate": rate, "ratio": ratio, "regions": regions, "cost": cost, "excess": excess}


def _bd_rates(folder: Path, measurements: Measurements) -> list[dict[str, Any]]:
    """Return for each anchor its name, the mean BD-rates of each codec by quality, and the codecs that have none."""
    rates = comparison.trace_bd_rates(measurements)
    means = comparison.mean_bd_rates(rates, measurements.kind_of)
    write_table(folder / "bd_rate_traces.csv", rates)
    write_table(folder / "bd_rate.csv", means)
    found = []
    for anchor in measurements.anchors:
        of_anchor = as_rows(means.filter(anchor=anchor, kind="").sort(pl.col("quality") != SNR.field, "mean"))
        of_codecs = [_by_quality(some) for some in charts.by_codec(of_anchor).values()]
        missing = [codec for codec in measurements.curves if codec not in {anchor, *(row.codec for row in of_anchor)}]
        found.append({"name": anchor, "codecs": of_codecs, "missing": missing})
    return found


def _by_quality(rows: Iterable[Any]) -> dict[str, Any]:
    found = {row.quality: row for row in rows}
    return {scale.field: found.get(scale.field) for scale in SCALES}


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
