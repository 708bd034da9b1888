"""The page's section on trained models: where they win and lose, what they take in time, bytes and flash."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from vibrocast.evaluation import charts
from vibrocast.evaluation.bd_rate import ENOUGH_POINTS, PSNR, Scale
from vibrocast.evaluation.comparison import (
    LEARNED_SCALES,
    REFERENCE,
    MeanBdRate,
    Measurements,
    Price,
    TraceBdRate,
    pair_bd_rates,
    prices,
    rival_bd_rates,
    with_runtime,
)
from vibrocast.evaluation.page_parts import (
    FEW_POINTS_MARK,
    bd_rate_text,
    chart,
    code,
    listed,
    number,
    paragraphs,
    percent,
    table,
)
from vibrocast.evaluation.points import write_rows
from vibrocast.evaluation.speed import BITS_PER_SAMPLE, RATIO


def section(folder: Path, measurements: Measurements) -> str:
    """Return the section, its charts and tables written into a folder; "" without trained models. Raises OSError."""
    if not measurements.learned:
        return ""
    rivals = rival_bd_rates(measurements)
    write_rows(folder / "learned_bd_rate.csv", rivals, MeanBdRate)
    return paragraphs(
        "## Trained models",
        f"Curves of trained models: {', '.join(map(code, measurements.learned))}.",
        "### Where they win and lose",
        "Bits of each relative to every other codec's at equal quality: BD-rate, mean over the traces that can be "
        f"compared. The nearest rivals first; {FEW_POINTS_MARK} marks fewer than {ENOUGH_POINTS} points of a curve. "
        "All pairs, also by kind of texture: [learned_bd_rate.csv](results/learned_bd_rate.csv).",
        "\n".join(_verdict(rivals, learned) for learned in measurements.learned),
        "By kind of texture; in brackets the traces on which it needs fewer bits, of those compared.",
        _kinds_table(measurements, rivals),
        _spread_chart(folder, measurements),
        "### What one more decibel costs",
        _prices(folder, measurements),
    )


def _prices(folder: Path, measurements: Measurements) -> str:
    rows = prices(measurements)
    write_rows(folder / "prices.csv", rows, Price)
    return paragraphs(
        f"At {BITS_PER_SAMPLE:g} bit/sample, compression ratio {RATIO:g}, the fastest decoder first. By a finer "
        "setting of the same codec: what one decibel more adds to the bytes. By another codec: what each decibel "
        "costs that it gains at equal bytes over the best of those that decode faster, in seconds per million samples "
        "and in flash (decoder's code, and model without its ONNX graph). Where it gains nothing, the time is lost.",
        table(
            (
                "codec",
                "SNR, dB",
                "1 dB in bytes",
                "gains, dB",
                "over",
                "1 dB in encoding, s",
                "in decoding, s",
                "in flash",
            ),
            [
                (
                    with_runtime(row),
                    number(row.snr_db),
                    percent(row.bytes_percent),
                    "" if row.gained_db is None else f"{row.gained_db:+.2f}",
                    row.than,
                    *map(number, (row.encode_s_per_megasample, row.decode_s_per_megasample)),
                    "" if row.flash_bytes is None else f"{row.flash_bytes / 1000:+.1f} kB",
                )
                for row in rows
            ],
        ),
        "Data: [prices.csv](results/prices.csv); charts: [speed against accuracy](#speed-against-accuracy).",
    )


def _verdict(rivals: Sequence[MeanBdRate], learned: str) -> str:
    """Say in one item whom a learned codec loses to, and how many it wins against, at each quality."""
    parts = []
    for scale in LEARNED_SCALES:
        rows = [row for row in rivals if (row.codec, row.quality, row.kind) == (learned, scale.field, "")]
        ranked = sorted(rows, key=lambda row: abs(row.mean))
        lost = [f"{code(row.anchor)} ({bd_rate_text(row)})" for row in ranked if row.mean >= 0]
        won = [f"{code(row.anchor)} ({bd_rate_text(row)})" for row in ranked if row.mean < 0]
        if rows:
            parts.append(
                f"at equal {_short(scale)} it loses to {listed(lost) or 'none'}"
                + (f", and wins against {len(won)}, the nearest {won[0]}" if won else "")
            )
    return f"- {code(learned)}: {'; '.join(parts) or 'not comparable'}."


def _short(scale: Scale) -> str:
    return scale.label.split(",")[0]


def _kinds_table(measurements: Measurements, rivals: Sequence[MeanBdRate]) -> str:
    """Return BD-rates at equal PSNR relative to the anchors, over all traces and by kind."""
    kinds = ["", *sorted(set(measurements.kind_of.values()))]
    found = {(row.codec, row.anchor, row.kind): row for row in rivals if row.quality == PSNR.field}
    lines = []
    for learned in measurements.learned:
        for anchor in measurements.anchors:
            cells = [found.get((learned, anchor, kind)) for kind in kinds]
            if any(cells) and anchor != learned:
                texts = [f"{bd_rate_text(row)} ({row.won} of {row.traces})" if row else "" for row in cells]
                lines.append((learned, anchor, *texts))
    return table(("bits at equal PSNR", "relative to", *(kind or "all" for kind in kinds)), lines)


def _spread_chart(folder: Path, measurements: Measurements) -> str:
    anchor = REFERENCE if REFERENCE in measurements.anchors else measurements.anchors[0]
    shown = [*measurements.learned, *(other for other in measurements.anchors if other != anchor)]
    rows = [
        row
        for learned in shown
        for scale in LEARNED_SCALES
        for row in pair_bd_rates(measurements, anchor, learned, scale)
    ]
    return paragraphs(
        f"Each trace relative to {code(anchor)}; a bar is the mean.",
        chart(
            folder,
            "learned_bd_rate_traces",
            rows,
            TraceBdRate,
            partial(charts.plot_bd_rates, scales=LEARNED_SCALES, kinds=measurements.kind_of),
            f"BD-rate relative to {anchor} on every trace",
            shown,
        ),
    )
