"""The page's section on trained models: where they win and lose, what they take in time, bytes and flash."""

from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from vibrocast.evaluation import charts
from vibrocast.evaluation.bd_rate import PSNR
from vibrocast.evaluation.comparison import (
    LEARNED_SCALES,
    REFERENCE,
    Measurements,
    marginal_costs,
    pair_bd_rates,
    rival_bd_rates,
)
from vibrocast.evaluation.tables import as_rows, write_table


def section(folder: Path, measurements: Measurements) -> dict[str, Any]:
    """Return what the section says, its charts and tables written into a folder. Raises OSError.

    Empty without trained models.
    """
    if not measurements.learned:
        return {}
    rivals = rival_bd_rates(measurements)
    costs = marginal_costs(measurements)
    write_table(folder / "learned_bd_rate.csv", rivals)
    write_table(folder / "prices.csv", costs)
    anchor = REFERENCE if REFERENCE in measurements.anchors else measurements.anchors[0]
    kinds = ["", *sorted(set(measurements.kind_of.values()))]
    return {
        "verdicts": {learned: _comparisons(rivals, learned) for learned in measurements.learned},
        "kind_names": [kind or "all" for kind in kinds],
        "kinds": _kinds(measurements, rivals, kinds),
        "anchor": anchor,
        "chart": _chart(folder, measurements, anchor),
        "marginal_costs": as_rows(costs),
    }


def _comparisons(rivals: pl.DataFrame, learned: str) -> list[dict[str, Any]]:
    """Return at each quality whom a learned codec loses to, and whom it wins against, the nearest first."""
    found = []
    for scale in LEARNED_SCALES:
        ranked = as_rows(rivals.filter(codec=learned, quality=scale.field, kind="").sort(pl.col("mean").abs()))
        if ranked:
            lost, won = ([row for row in ranked if (row.mean < 0) == wins] for wins in (False, True))
            found.append({"quality": scale.name, "lost": lost, "won": won})
    return found


def _kinds(measurements: Measurements, rivals: pl.DataFrame, kinds: list[str]) -> list[tuple[str, str, list[Any]]]:
    """Return BD-rates at equal PSNR relative to the anchors, over all traces and by kind."""
    found = {(row.codec, row.anchor, row.kind): row for row in as_rows(rivals.filter(quality=PSNR.field))}
    lines = [
        (learned, anchor, [found.get((learned, anchor, kind)) for kind in kinds])
        for learned in measurements.learned
        for anchor in measurements.anchors
        if anchor != learned
    ]
    return [line for line in lines if any(line[2])]


def _chart(folder: Path, measurements: Measurements, anchor: str) -> charts.Chart:
    shown = [*measurements.learned, *(other for other in measurements.anchors if other != anchor)]
    pairs = [(scale, anchor, learned) for learned in shown for scale in LEARNED_SCALES]
    return charts.Chart(
        "learned_bd_rate_traces",
        f"BD-rate relative to {anchor} on every trace",
        pair_bd_rates(measurements, pairs),
        tuple(shown),
    ).write(folder, partial(charts.plot_bd_rates, scales=LEARNED_SCALES, kinds=measurements.kind_of))
