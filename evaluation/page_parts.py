"""Pieces of a page in Markdown: paragraphs, tables, numbers, charts with their data."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from vibrocast.evaluation.bd_rate import ENOUGH_POINTS, Summary
from vibrocast.evaluation.charts import CodecRow
from vibrocast.evaluation.points import write_rows

FEW_POINTS_MARK = "†"
"""Behind a BD-rate that rests on fewer than ENOUGH_POINTS points of a curve."""


def paragraphs(*parts: str) -> str:
    """Return the parts that are not empty, a blank line between them."""
    return "\n\n".join(part for part in parts if part)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table, its first column to the left; without rows, nothing."""
    if not rows:
        return ""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *([_text(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _text(cell: str) -> str:
    """Return text that a table shows as it is."""
    return " ".join(cell.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").split())


def code(text: str) -> str:
    """Return a name as code."""
    return f"`{text.replace('`', '')}`"


def count(number: int, what: str) -> str:
    """Return a number of things in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def number(value: float | None) -> str:
    """Return a number with three digits; empty where there is none."""
    return "" if value is None else f"{value:.3g}"


def percent(value: float | None) -> str:
    """Return a difference in percent; empty where there is none."""
    return "" if value is None else f"{value:+.1f} %"


def bd_rate_text(row: Summary) -> str:
    """Return a mean BD-rate in percent, marked where a curve has few points."""
    return percent(row.mean) + FEW_POINTS_MARK * (row.points < ENOUGH_POINTS)


def listed(items: Sequence[str]) -> str:
    """Return items as a person lists them."""
    return " and ".join(filter(None, (", ".join(items[:-1]), *items[-1:])))


def chart(
    folder: Path,
    stem: str,
    rows: Sequence[CodecRow],
    kind: type[CodecRow],
    plot: Callable[[Path, Sequence[CodecRow]], None],
    title: str,
    expected: Iterable[str],
) -> str:
    """Write a chart and its data, and return its place on the page; without data only that there is none.

    Raises OSError.
    """
    image = folder / f"{stem}.png"
    write_rows(folder / f"{stem}.csv", rows, kind)
    if not rows:
        image.unlink(missing_ok=True)
        return f"{title}: no codec has the values."
    plot(image, rows)
    drawn = {row.codec for row in rows}
    missing = [code(codec) for codec in expected if codec not in drawn]
    return paragraphs(
        f"![{title}](results/{stem}.png)",
        f"*{title}; data: [{stem}.csv](results/{stem}.csv).*"
        + (f" Without the values on every trace, and not drawn: {', '.join(missing)}." if missing else ""),
    )
