"""Sets quality at an equal rate against the load of two processors: `python -m studies.embedded_load --out OUT`."""

from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click
import polars as pl

from studies import firmware, page
from studies.firmware import DSP, PORTABLE, RATE_HZ, Load, Size
from vibrocast.evaluation import charts, comparison
from vibrocast.evaluation.bd_rate import SNR, SPQI
from vibrocast.evaluation.comparison import Measurements
from vibrocast.evaluation.points import read_rows
from vibrocast.evaluation.results_page import EMBEDDED

BITS_PER_SAMPLE = 0.8
"""Near the rates of 10 dB SNR, at which the loads are counted."""
SCALES = (SNR, SPQI)
PROCESSORS = {
    ("M4F", DSP): "load of a Cortex-M4F at 168 MHz, % of its cycles",
    ("M0+", PORTABLE): "load of a Cortex-M0+ at 133 MHz, % by instructions",
}
"""Core and kernels of the loads, and the axis of each."""


def rows(measurements: Measurements, loads: Sequence[Load], sizes: Sequence[Size]) -> pl.DataFrame:
    """Return a row for each decoder, quality and processor, of those that have a quality at BITS_PER_SAMPLE.

    Columns: `quality`, `codec`, `curve` (the best of the decoder's, whose quality it is), `source`, `bits_per_sample`,
    `value`, `cost` (the axis), `per_sample` (cycles or instructions), `load_percent` of one channel at RATE_HZ, and
    `memory_bytes` (code, image and state).
    """
    costs, memory = firmware.mean_loads(loads), {(size.decoder, size.kernels): size for size in sizes}
    found = []
    for scale, decoder in product(SCALES, dict.fromkeys(size.decoder for size in sizes)):
        means = comparison.means_at(measurements, scale, BITS_PER_SAMPLE)
        curves = [name for name in means if decoder in (name, measurements.owner(name))]
        if not curves:
            continue
        best = max(curves, key=lambda name: means[name])
        for (core, kernels), axis in PROCESSORS.items():
            where = scale.field, decoder, best, measurements.source(best), BITS_PER_SAMPLE, means[best], axis
            load, size = costs[decoder, core, kernels], memory[decoder, kernels]
            by_cycles = load.cycles, load.cycles_percent
            counted = (load.instructions, load.load_percent) if load.cycles is None else by_cycles
            found.append((*where, *counted, size.code_bytes + size.image_bytes + size.state_1_bytes))
    text = dict.fromkeys(("quality", "codec", "curve", "source"), pl.String)
    numbers = {"per_sample": pl.Float64, "load_percent": pl.Float64, "memory_bytes": pl.Int64}
    columns: dict[str, Any] = {**text, "bits_per_sample": pl.Float64, "value": pl.Float64, "cost": pl.String, **numbers}
    return pl.DataFrame(found, columns, orient="row")


@page.study
def main(out: Path) -> None:
    """Draw OUT/results/embedded_load.svg from the tables of a benchmark in OUT/results and of studies.firmware."""
    results = page.results_folder(out)
    tables: dict[str, Any] = {
        name: read_rows(results / f"{name}.csv", kind) for name, kind in comparison.TABLES.items()
    }
    table = rows(Measurements(**tables), firmware.stored(Load), firmware.stored(Size))
    title = f"Quality at {BITS_PER_SAMPLE:g} bit/sample against the load of one channel at {RATE_HZ} Hz"
    drawn = charts.Chart(Path(EMBEDDED).stem, title, table)
    drawn.write(results, partial(charts.plot_loads, scales=SCALES))
    click.echo(f"{results / EMBEDDED}: {drawn.rows} rows")


if __name__ == "__main__":
    main()
