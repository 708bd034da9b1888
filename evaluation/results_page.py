"""The results page, charts and tables; `python -m vibrocast.evaluation.results_page OUT` draws it again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
import polars as pl

from vibrocast import pages
from vibrocast.errors import InputError
from vibrocast.evaluation import bd_rate, charts, comparison, learned_page, speed
from vibrocast.evaluation.bd_rate import PSNR, SCALES, SNR, SPQI, ST_SIM_2800, ST_SIM_8000, Scale
from vibrocast.evaluation.comparison import LEARNED_SCALES, PAPER_SCALES, TABLES, TIMES, Measurements
from vibrocast.evaluation.peers import measured_codecs, named, peers
from vibrocast.evaluation.points import IMPORTED, MEASURED, PROGRAM, read_row, read_rows, write_rows
from vibrocast.evaluation.tables import as_rows, by_codec, grouped, write_table
from vibrocast.pages import listed

NOTE = "note.md"
"""In OUT/results: a text of your own in Markdown, which the page shows among its evidence."""
HELD_OUT = "held_out.csv"
"""In OUT/results: rows of HeldOut, if codecs were measured on recordings kept apart."""
EMBEDDED = "embedded_load.svg"
"""In OUT/results: the chart of studies.embedded_load, if it was drawn."""
ALL_PEERS = "all peers"
TEMPLATE = Path(__file__).with_name("results.md.jinja")
RATE_SCALES = (SNR, ST_SIM_2800, SPQI)
COST_SCALES = (SNR, SPQI)
SHOWN_SCALES = (SNR, PSNR, ST_SIM_2800, SPQI)
"""Of the table of BD-rates; bd_rate.csv has all."""
HEADLINE = ("mdct-live", "slp", "lc3@relabel")
"""Curves that the first table has in addition to one of each group in colour."""
MAX_NAMED = 4
MAX_LISTED_FAILURES = 20
RULES = {
    "confidence": bd_rate.CONFIDENCE,
    "enough_points": bd_rate.ENOUGH_POINTS,
    "equal_snr_db": comparison.EQUAL_SNR_DB,
    "max_ratio": comparison.MAX_RATIO,
    "min_overlap": bd_rate.MIN_OVERLAP,
    "min_points": bd_rate.MIN_POINTS,
    "min_ratio": comparison.MIN_RATIO,
    "needed_snr_db": comparison.NEEDED_SNR_DB,
    "rate": speed.BITS_PER_SAMPLE,
    "ratio": speed.RATIO,
}
"""Figures in the page's words."""


@dataclass(frozen=True)
class Description:
    """A run: the name of its data, the class of machine that took the times, the command that repeats it."""

    data: str
    machine: str
    command: str


@dataclass(frozen=True)
class HeldOut:
    """Bits of a codec relative to a peer's on recordings kept apart, in percent: the mean, and the worst recording."""

    codec: str
    measure: str
    peer: str
    mean_percent: float | None
    worst_percent: float | None


def write_results(
    out: Path,
    measurements: Measurements,
    description: Description,
    held_out: Sequence[HeldOut] = (),
    progress: Callable[[float], object] = lambda part: None,
    redrawn: bool = False,
) -> None:
    """Write OUT/results.md and, in OUT/results, its charts and tables, each with its data as CSV, and the description.

    Imported points count where no codec of that name was measured, on the recordings that were. `progress` is called
    with the part done, from 0 to 1. `redrawn`: the page there is of these figures. Raises OSError where a file cannot
    be written.
    """
    folder = out / "results"
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(folder / "description.csv", [description], Description)
    means = _bd_rates(folder, measurements)
    progress(0.4)
    reached = _written(folder / f"at_{comparison.NEEDED_SNR_DB:g}_db.csv", comparison.at_needed_snr, measurements)
    costs = _written(folder / "curve_costs.csv", comparison.curve_costs, measurements)
    parts: dict[str, Callable[[], Any]] = {
        "learned": partial(learned_page.section, folder, measurements),
        "recommendations": partial(_written, folder / "advice.csv", comparison.recommendations, measurements),
        "charts": partial(_charts, folder, measurements, means, reached),
    }
    values: dict[str, Any] = {}
    for place, (name, make) in enumerate(parts.items(), 1):
        values[name] = make()
        progress(0.4 + 0.6 * place / len(parts))
    page = pages.render(
        TEMPLATE,
        **_head(folder, measurements),
        **values,
        **_message(measurements, means, reached, costs, held_out),
        bd_rates=_anchor_table(measurements, means),
        costs=[row for row in costs if row.source != IMPORTED],
        description=description,
        measurements=measurements,
        name=charts.name,
    )
    pages.write_figures(out / "results.md", page, redrawn)


def read_held_out(folder: Path) -> list[HeldOut]:
    """Return the rows of HELD_OUT, none without that file. Raises InputError, OSError."""
    path = folder / HELD_OUT
    return read_rows(path, HeldOut) if path.exists() else []


def _head(folder: Path, measurements: Measurements) -> dict[str, Any]:
    """Return the values of the page besides message, tables and charts."""
    summaries = []
    for known in measured_codecs().values():
        if curves := [codec for codec in measurements.curves if measurements.owner(codec) == known.name]:
            summaries.append((curves, known.summary))
    by_source = {
        source: [codec for codec in measurements.curves if measurements.source(codec) == source]
        for source in (MEASURED, PROGRAM, IMPORTED)
    }
    imported = [named(codec) for codec in by_source[IMPORTED]]
    failures = grouped(measurements.failures, lambda failure: (failure.codec, failure.reason))
    return {
        "samples": measurements.drawn.unique("trace", keep="last")["samples"].sum(),
        "rates_hz": sorted(measurements.drawn["rate_hz"].drop_nulls().unique()),
        "left_out": [trace for trace in measurements.traces if trace not in measurements.compared],
        "codecs": summaries,
        "programs": by_source[PROGRAM],
        "imported": imported,
        "note": note.read_text(encoding="utf-8").strip() if (note := folder / NOTE).exists() else "",
        "failures": [(*kind, some) for kind, some in failures.items()],
        "embedded": EMBEDDED if (folder / EMBEDDED).exists() else "",
        "max_listed_failures": MAX_LISTED_FAILURES,
        "scales": SHOWN_SCALES,
        "all_scales": SCALES,
        "rules": RULES,
    }


def _message(
    measurements: Measurements,
    means: Sequence[Any],
    reached: Sequence[Any],
    costs: Sequence[Any],
    held_out: Sequence[HeldOut],
) -> dict[str, Any]:
    """Return the values of the page's first lines: the anchor compared with known peers, and where it loses."""
    anchor = measurements.anchor
    own = next((row for row in reached if row.codec == anchor), None)
    groups = charts.best_of_groups(by_codec(reached), lambda rows: -rows[0].bits_per_sample)
    in_colour = {codec for codec in groups if not charts.is_grey(codec)}
    shown = [row for row in reached if row.codec in in_colour or row.codec in HEADLINE]
    of_anchor = [row for row in held_out if (row.codec, row.measure) == (anchor, SNR.name)]
    by_group = {charts.group_of(row.peer.lower().replace("-", "")): row for row in of_anchor}
    decoding: dict[str, Any] = {}
    for cost in costs:
        decoding.setdefault(cost.codec, cost)
    return {
        "anchor": anchor,
        "own": own,
        "headline": shown,
        "best_peer": next((row for row in reached if row.codec in peers() and anchor not in peers()), None),
        "held_out": {row.codec: by_group[group] for row in shown if (group := charts.group_of(row.codec)) in by_group},
        "kept_apart": [row for row in held_out if (row.codec, row.peer) == (anchor, ALL_PEERS)],
        "decoding": decoding,
        "losses": _losses(anchor, means, reached, decoding),
        "max_named": MAX_NAMED,
    }


def _losses(
    anchor: str, means: Sequence[Any], reached: Sequence[Any], costs: Mapping[str, Any]
) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return in which figure, and to which codecs, the anchor loses: the best of each group, each with its figure."""
    found = []
    for scale in RATE_SCALES:
        ahead = sorted((row for row in means if row.quality == scale.field and row.mean < 0), key=lambda row: row.mean)
        found.append((f"bits at equal {scale.name}", [(row.codec, f"{row.mean:+.1f} %") for row in ahead]))
    usable = {row.codec: row for row in reached if row.source != IMPORTED}
    if anchor not in usable:
        return [(words, ahead) for words, ahead in found if ahead]
    columns: Sequence[tuple[str, Mapping[str, Any], str, Callable[[float], str]]] = (
        ("encoding time", costs, "encode_s_per_megasample", lambda value: f"{value:.3g} s"),
        ("decoding time", costs, "decode_s_per_megasample", lambda value: f"{value:.3g} s"),
        ("decoder and model", costs, "flash_bytes", lambda value: pages.size(int(value))),
        ("delay", usable, "delay_high_ms", lambda value: f"{value:.3g} ms"),
    )
    for words, rows, column, form in columns:
        values = {codec: value for codec in usable if (value := getattr(rows[codec], column)) is not None}
        if anchor in values:
            ranked = sorted(
                (codec for codec in values if values[codec] < values[anchor]), key=lambda codec: values[codec]
            )
            first = {charts.group_of(codec): codec for codec in reversed(ranked)}
            ahead = [codec for codec in ranked if codec in first.values()]
            found.append((f"{words} ({form(values[anchor])})", [(codec, form(values[codec])) for codec in ahead]))
    return [(words, ahead) for words, ahead in found if ahead]


def _written(path: Path, make: Callable[[Measurements], pl.DataFrame], measurements: Measurements) -> list[Any]:
    table = make(measurements)
    write_table(path, table)
    return as_rows(table)


def _charts(folder: Path, measurements: Measurements, means: Sequence[Any], reached: Sequence[Any]) -> dict[str, Any]:
    anchor = measurements.anchor
    rate_hz = measurements.rate_hz
    curves = {scale: comparison.mean_curves(measurements, scale) for scale in (*RATE_SCALES, ST_SIM_8000)}
    write_table(folder / f"quality_against_rate_{ST_SIM_8000.field}.csv", curves[ST_SIM_8000])
    every, pair = tuple(measurements.curves), tuple(measurements.paper_pair)

    def over_rate(scale: Scale) -> charts.Chart:
        title = _title(scale, anchor, [row for row in means if row.quality == scale.field])
        chart = charts.Chart(f"quality_against_rate_{scale.field}", title, curves[scale], every)
        return chart.write(folder, partial(charts.plot_quality_against_rate, scale=scale, rate_hz=rate_hz))

    def over_costs(scale: Scale, stem: str, words: str, costs: Sequence[str]) -> charts.Chart:
        title = f"{scale.name} at {speed.BITS_PER_SAMPLE:g} bit/sample against {words}: the line joins the best"
        table = comparison.cost_points(measurements, scale, costs)
        chart = charts.Chart(f"quality_against_{stem}_{scale.field}", title, table)
        return chart.write(folder, partial(charts.plot_cost_points, scale=scale))

    ratios = comparison.ratio_points(measurements, LEARNED_SCALES)
    ratio = charts.Chart("quality_against_ratio", "PSNR, ST-SIM and SPQI against compression ratio", ratios, pair)
    regions = charts.Chart(
        "bd_regions", "Where BD-rate integrates", comparison.bd_regions(measurements, PAPER_SCALES), pair
    )
    title = f"Bits above the best codec's at {comparison.EQUAL_SNR_DB:g} dB SNR, in percent"
    excess = charts.Chart("excess_bits", title, comparison.rate_excesses(measurements), every)
    return {
        "main": _first_look(folder, anchor, curves[SNR], reached, rate_hz),
        "rate": [over_rate(scale) for scale in RATE_SCALES],
        "ratio": ratio.write(folder, partial(charts.plot_quality_against_ratio, scales=LEARNED_SCALES)),
        "regions": regions.write(folder, partial(charts.plot_bd_regions, scales=PAPER_SCALES)),
        "time": [over_costs(scale, "time", "time", TIMES) for scale in COST_SCALES],
        "delay": [over_costs(scale, "delay", "delay and size", ("delay_ms", "flash_bytes")) for scale in COST_SCALES],
        "excess": excess.write(folder, charts.plot_rate_excesses),
    }


def _title(scale: Scale, anchor: str, compared: Sequence[Any]) -> str:
    fewer = sum(row.mean > 0 for row in compared)
    if not fewer:
        return f"{scale.label} against bits per sample"
    return f"At equal {scale.name}, {anchor} needs fewer bits than {fewer} of {len(compared)} other curves"


def _first_look(
    folder: Path, anchor: str, curves: pl.DataFrame, reached: Sequence[Any], rate_hz: float | None
) -> dict[str, str] | None:
    """Draw the anchor and known peers for a first look; return the chart's title, None without any such peer."""
    shown = [codec for codec in charts.main_curves(curves) if charts.group_of(codec) != charts.MAIN[0]]
    path = folder / "comparison.svg"
    percents = [-row.anchor_percent for row in reached if row.codec in shown and row.anchor_percent is not None]
    if anchor != charts.MAIN[0] or len(percents) < len(shown) or not shown:
        path.unlink(missing_ok=True)
        return None
    ends = listed(dict.fromkeys(f"{percent:.0f}" for percent in (min(percents), max(percents))), " to ")
    title = f"At equal SNR, {anchor} needs {ends} % fewer bits"
    charts.plot_comparison(path, curves, title=title, rate_hz=rate_hz)
    return {"title": title, "stem": path.stem}


def _bd_rates(folder: Path, measurements: Measurements) -> list[Any]:
    """Write the BD-rates of all anchors; return the mean ones relative to the first, over all recordings."""
    rates = comparison.trace_bd_rates(measurements)
    means = comparison.mean_bd_rates(rates, measurements.kind_of)
    write_table(folder / "bd_rate_traces.csv", rates)
    write_table(folder / "bd_rate.csv", means)
    return as_rows(means.filter(anchor=measurements.anchor, kind=""))


def _anchor_table(measurements: Measurements, means: Sequence[Any]) -> dict[str, Any]:
    """Return the mean BD-rates of each codec by quality, and the codecs that have none."""
    ranked = sorted(means, key=lambda row: (row.quality != SNR.field, row.mean))
    rows = [{row.quality: row for row in some} for some in by_codec(ranked).values()]
    with_rates = {measurements.anchor, *(row.codec for row in means)}
    return {"codecs": rows, "missing": [codec for codec in measurements.curves if codec not in with_rates]}


@click.command()
@click.argument("out", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(out: Path) -> None:
    """Draw the page OUT/results.md and its charts again, from the CSV files in OUT/results."""
    folder = out / "results"
    try:
        description = read_row(folder / "description.csv", Description)
        tables: dict[str, Any] = {name: read_rows(folder / f"{name}.csv", kind) for name, kind in TABLES.items()}
        write_results(out, Measurements(**tables), description, read_held_out(folder), redrawn=True)
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}; give the --out of a benchmark") from error
    except InputError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
