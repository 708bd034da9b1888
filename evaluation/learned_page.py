"""The page's section on trained models: their bits by kind of texture, and the time and flash that quality costs."""

from functools import partial
from pathlib import Path
from typing import Any

from vibrocast.evaluation import charts
from vibrocast.evaluation.bd_rate import SNR
from vibrocast.evaluation.comparison import (
    LEARNED_SCALES,
    REFERENCE,
    Measurements,
    marginal_costs,
    mean_bd_rates,
    pair_bd_rates,
    rival_bd_rates,
)
from vibrocast.evaluation.tables import as_rows, write_table


def section(folder: Path, measurements: Measurements) -> dict[str, Any]:
    """Return the values of the section, its charts and tables written into a folder. Raises OSError.

    Empty without trained models.
    """
    if not measurements.learned:
        return {}
    costs = marginal_costs(measurements)
    write_table(folder / "learned_bd_rate.csv", rival_bd_rates(measurements))
    write_table(folder / "prices.csv", costs)
    anchor = REFERENCE if REFERENCE in measurements.anchors else measurements.anchor
    kinds = ["", *sorted(set(measurements.kind_of.values()))]
    return {
        "kind_names": [kind or "all" for kind in kinds],
        "kinds": _kinds(measurements, kinds),
        "anchor": anchor,
        "chart": _chart(folder, measurements, anchor),
        "marginal_costs": [row for row in as_rows(costs) if row.gained_db is None or row.gained_db > 0],
    }


def _kinds(measurements: Measurements, kinds: list[str]) -> list[tuple[Any, list[Any]]]:
    """Return BD-rates at equal SNR relative to the first anchor: over all recordings, then by kind."""
    anchor = measurements.anchor
    pairs = [(SNR, anchor, learned) for learned in measurements.learned]
    means = as_rows(mean_bd_rates(pair_bd_rates(measurements, pairs), measurements.kind_of))
    found = {(row.codec, row.kind): row for row in means}
    return [
        (found[learned, ""], [found.get((learned, kind)) for kind in kinds])
        for learned in measurements.learned
        if (learned, "") in found
    ]


def _chart(folder: Path, measurements: Measurements, anchor: str) -> charts.Chart:
    shown = [*measurements.learned, *(other for other in measurements.anchors if other != anchor)]
    pairs = [(scale, anchor, learned) for learned in shown for scale in LEARNED_SCALES]
    return charts.Chart(
        "learned_bd_rate_traces",
        f"Bits of trained models relative to {anchor}: a mark is a recording",
        pair_bd_rates(measurements, pairs),
        tuple(shown),
    ).write(folder, partial(charts.plot_bd_rates, scales=LEARNED_SCALES, kinds=measurements.kind_of))
