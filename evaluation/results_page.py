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
from vibrocast.evaluation import bd_rate, charts, comparison, pictures, speed
from vibrocast.evaluation.bd_rate import PSNR, SCALES, SNR, SPQI, ST_SIM_2800, ST_SIM_8000, Scale
from vibrocast.evaluation.comparison import LEARNED_SCALES, PAPER_SCALES, TABLES, TIMES, Measurements
from vibrocast.evaluation.peers import measured_codecs, named, peers
from vibrocast.evaluation.points import IMPORTED, MEASURED, PROGRAM, Failure, read_row, read_rows, write_rows
from vibrocast.evaluation.tables import by, frame, write_table
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
    "min_overlap": bd_rate.MIN_OVERLAP,
    "min_points": bd_rate.MIN_POINTS,
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
    progress: Callable[[float], object] = lambda part: None,
    redrawn: bool = False,
) -> None:
    """Write OUT/results.md and, in OUT/results, its charts and tables, each with its data as CSV, and the description.

    Imported points count where no codec of that name was measured, on the recordings that were. `progress` is called
    with the part done, from 0 to 1. `redrawn`: the page there is of these figures. Raises InputError for a HELD_OUT of
    other form, OSError where a file cannot be written.
    """
    folder = out / "results"
    folder.mkdir(parents=True, exist_ok=True)
    held_out = read_held_out(folder)
    write_rows(folder / "description.csv", [description], Description)
    rates = comparison.trace_bd_rates(measurements)
    write_table(folder / "bd_rate_traces.csv", rates)
    every = _written(folder / "bd_rate.csv", comparison.mean_bd_rates(rates, measurements.kind_of))
    means = every.filter(anchor=measurements.anchor, kind="")
    progress(0.4)
    reached = _written(folder / f"at_{comparison.NEEDED_SNR_DB:g}_db.csv", comparison.at_needed_snr(measurements))
    costs = _written(folder / "curve_costs.csv", comparison.curve_costs(measurements))
    learned = _learned(folder, measurements)
    progress(0.6)
    recommendations = _written(folder / "advice.csv", comparison.recommendations(measurements))
    drawn = _charts(folder, measurements, means, reached)
    progress(1)
    page = pages.render(
        TEMPLATE,
        **_head(folder, measurements),
        **_message(measurements, means, reached, costs, held_out),
        learned=learned,
        recommendations=recommendations.to_dicts(),
        charts=drawn,
        bd_rates=_anchor_table(measurements, means),
        costs=costs.filter(pl.col("source") != IMPORTED).to_dicts(),
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
    failures = by(frame(measurements.failures, Failure), "codec", "reason")
    return {
        "samples": measurements.drawn.unique("trace", keep="last")["samples"].sum(),
        "rates_hz": sorted(measurements.drawn["rate_hz"].drop_nulls().unique()),
        "left_out": [trace for trace in measurements.traces if trace not in measurements.compared],
        "codecs": summaries,
        "programs": by_source[PROGRAM],
        "imported": imported,
        "note": note.read_text(encoding="utf-8").strip() if (note := folder / NOTE).exists() else "",
        "failures": [(*kind, some.to_dicts()) for kind, some in failures],
        "embedded": EMBEDDED if (folder / EMBEDDED).exists() else "",
        "max_listed_failures": MAX_LISTED_FAILURES,
        "scales": SHOWN_SCALES,
        "all_scales": SCALES,
        "rules": RULES,
    }


def _message(
    measurements: Measurements,
    means: pl.DataFrame,
    reached: pl.DataFrame,
    costs: pl.DataFrame,
    held_out: Sequence[HeldOut],
) -> dict[str, Any]:
    """Return the values of the page's first lines: the anchor compared with known peers, and where it loses."""
    anchor, rows = measurements.anchor, reached.to_dicts()
    in_colour = {
        codec for codec in charts.best_of_groups(reached, -pl.first("bits_per_sample")) if not charts.is_grey(codec)
    }
    shown = [row for row in rows if row["codec"] in in_colour or row["codec"] in HEADLINE]
    of_anchor = [row for row in held_out if (row.codec, row.measure) == (anchor, SNR.name)]
    by_group = {charts.group_of(row.peer.lower().replace("-", "")): row for row in of_anchor}
    groups = {row["codec"]: charts.group_of(row["codec"]) for row in shown}
    decoding = {row["codec"]: row for row in costs.unique("codec", keep="first").to_dicts()}
    return {
        "anchor": anchor,
        "own": next((row for row in rows if row["codec"] == anchor), None),
        "headline": shown,
        "best_peer": next((row for row in rows if row["codec"] in peers() and anchor not in peers()), None),
        "held_out": {codec: by_group[group] for codec, group in groups.items() if group in by_group},
        "kept_apart": [row for row in held_out if (row.codec, row.peer) == (anchor, ALL_PEERS)],
        "decoding": decoding,
        "losses": _losses(anchor, means, reached, decoding),
        "max_named": MAX_NAMED,
    }


def _losses(
    anchor: str, means: pl.DataFrame, reached: pl.DataFrame, costs: Mapping[str, Any]
) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return in which figure, and to which codecs, the anchor loses: the best of each group, each with its figure."""
    found = []
    for scale in RATE_SCALES:
        ahead = means.filter((pl.col("quality") == scale.field) & (pl.col("mean") < 0)).sort(
            "mean", maintain_order=True
        )
        words = [(codec, f"{mean:+.1f} %") for codec, mean in ahead.select("codec", "mean").rows()]
        found.append((f"bits at equal {scale.name}", words))
    usable = {row["codec"]: row for row in reached.filter(pl.col("source") != IMPORTED).to_dicts()}
    columns: Sequence[tuple[str, Mapping[str, Any], str, Callable[[float], str]]] = (
        ("encoding time", costs, "encode_s_per_megasample", lambda value: f"{value:.3g} s"),
        ("decoding time", costs, "decode_s_per_megasample", lambda value: f"{value:.3g} s"),
        ("decoder and model", costs, "flash_bytes", lambda value: pages.size(int(value))),
        ("delay", usable, "delay_high_ms", lambda value: f"{value:.3g} ms"),
    )
    for title, rows, column, form in columns:
        values = {codec: value for codec in usable if (value := rows[codec][column]) is not None}
        if anchor in values:
            ranked = sorted((codec for codec in values if values[codec] < values[anchor]), key=values.__getitem__)
            first = {charts.group_of(codec): codec for codec in reversed(ranked)}
            words = [(codec, form(values[codec])) for codec in ranked if codec in first.values()]
            found.append((f"{title} ({form(values[anchor])})", words))
    return [(title, words) for title, words in found if words]


def _written(path: Path, table: pl.DataFrame) -> pl.DataFrame:
    write_table(path, table)
    return table


def _charts(folder: Path, measurements: Measurements, means: pl.DataFrame, reached: pl.DataFrame) -> dict[str, Any]:
    anchor = measurements.anchor
    rate_hz = measurements.rate_hz
    curves = {scale: comparison.mean_curves(measurements, scale) for scale in (*RATE_SCALES, ST_SIM_8000)}
    write_table(folder / f"quality_against_rate_{ST_SIM_8000.field}.csv", curves[ST_SIM_8000])
    every, pair = tuple(measurements.curves), tuple(measurements.paper_pair)

    def over_rate(scale: Scale) -> charts.Chart:
        title = _title(scale, anchor, means.filter(quality=scale.field))
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


def _title(scale: Scale, anchor: str, compared: pl.DataFrame) -> str:
    fewer = (compared["mean"] > 0).sum()
    if not fewer:
        return f"{scale.label} against bits per sample"
    return f"At equal {scale.name}, {anchor} needs fewer bits than {fewer} of {len(compared)} other curves"


def _first_look(
    folder: Path, anchor: str, curves: pl.DataFrame, reached: pl.DataFrame, rate_hz: float | None
) -> dict[str, str] | None:
    """Draw the anchor and known peers for a first look; return the chart's title, None without any such peer."""
    shown = [codec for codec in charts.main_curves(curves) if charts.group_of(codec) != charts.MAIN[0]]
    path = folder / "comparison.svg"
    percents = (-reached.filter(pl.col("codec").is_in(shown))["anchor_percent"].drop_nulls()).to_list()
    if anchor != charts.MAIN[0] or len(percents) < len(shown) or not shown:
        pictures.remove(path)
        return None
    ends = listed(dict.fromkeys(f"{percent:.0f}" for percent in (min(percents), max(percents))), " to ")
    title = f"At equal SNR, {anchor} needs {ends} % fewer bits"
    charts.plot_comparison(path, curves, title=title, rate_hz=rate_hz)
    return {"title": title, "stem": path.stem}


def _learned(folder: Path, measurements: Measurements) -> dict[str, Any]:
    """Return the values of the section on trained models: their bits by kind of texture.

    Empty without trained models.
    """
    learned, kinds = measurements.learned, ["", *sorted(set(measurements.kind_of.values()))]
    if not learned:
        return {}
    write_table(folder / "learned_bd_rate.csv", comparison.rival_bd_rates(measurements))
    pairs = [(SNR, measurements.anchor, codec) for codec in learned]
    means = comparison.mean_bd_rates(comparison.pair_bd_rates(measurements, pairs), measurements.kind_of)
    found = {(row["codec"], row["kind"]): row for row in means.to_dicts()}
    return {
        "kind_names": [kind or "all" for kind in kinds],
        "kinds": [
            (found[codec, ""], [found.get((codec, kind)) for kind in kinds])
            for codec in learned
            if (codec, "") in found
        ],
    }


def _anchor_table(measurements: Measurements, means: pl.DataFrame) -> dict[str, Any]:
    """Return the mean BD-rates of each codec by quality, and the codecs that have none."""
    ranked = means.sort(pl.col("quality") != SNR.field, "mean", maintain_order=True)
    rows = [{row["quality"]: row for row in own.to_dicts()} for _, own in by(ranked, "codec")]
    with_rates = {measurements.anchor, *means["codec"]}
    return {"codecs": rows, "missing": [codec for codec in measurements.curves if codec not in with_rates]}


@click.command()
@click.argument("out", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(out: Path) -> None:
    """Draw the page OUT/results.md and its charts again, from the CSV files in OUT/results."""
    folder = out / "results"
    try:
        description = read_row(folder / "description.csv", Description)
        tables: dict[str, Any] = {name: read_rows(folder / f"{name}.csv", kind) for name, kind in TABLES.items()}
        write_results(out, Measurements(**tables), description, redrawn=True)
    except OSError as error:
        raise click.ClickException(f"{error.filename}: {error.strerror}; give the --out of a benchmark") from error
    except InputError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
