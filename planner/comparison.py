"""Compares forecasts of a plan with measurements of its playback: a table, and the failures."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from msgspec import structs

from vibrocast.host.figures import FIGURES, Figure
from vibrocast.planner.page import write_table
from vibrocast.planner.playing import Played


@dataclass(frozen=True)
class Row:
    """One figure of one texture. `measured`: None if nothing measured it."""

    texture: str
    figure: Figure
    forecast: float
    measured: float | None

    @property
    def deviation(self) -> float | None:
        """The deviation relative to the forecast; of levels as amplitudes, so 1 dB is 12 %."""
        if self.measured is None:
            return None
        if self.figure.unit == "dB":
            return math.pow(10.0, (self.measured - self.forecast) / 20) - 1
        return self.measured / self.forecast - 1 if self.forecast else float(self.measured != self.forecast)

    @property
    def within(self) -> bool | None:
        """Whether the measurement is as forecast, within the figure's tolerance; None if nothing measured it."""
        return None if self.measured is None else not self.figure.differs(self.forecast, self.measured)


def rows(played: Sequence[Played]) -> list[Row]:
    """Return every forecast with its measurement."""
    return [
        Row(each.texture.name, FIGURES[key], forecast, each.measured.get(key))
        for each in played
        for key, forecast in structs.asdict(each.texture.forecast).items()
        if forecast is not None
    ]


def failures(played: Sequence[Played], compared: Sequence[Row]) -> list[str]:
    """Return a line for each failure: late packets, samples that differ from those sent, and wrong forecasts."""
    found = []
    for each in played:
        if each.report.lost_anything:
            found.append(
                f"{each.texture.name}: {each.report.underruns} underruns, {each.report.lost_packets} lost packets; the "
                "computer or the link is too busy, or the playout delay too short; raise buffer_ms in the plan"
            )
        if each.report.differs:
            found.append(
                f"{each.texture.name}: the controller's samples differ from those that the host computes; test it with "
                "`vibrocast conformance`"
            )
    found += [
        f"{row.texture}: {row.figure.label} deviates by {100 * row.deviation:+.1f} % from its forecast"
        for row in compared
        if row.within is False and row.deviation is not None
    ]
    return found


def lines(compared: Sequence[Row]) -> list[str]:
    """Return a table of all figures as lines of text."""
    header = ("texture", "", "forecast", "measured", "deviation")
    cells = [header]
    for row in compared:
        figure, deviation = row.figure, row.deviation
        off = "" if deviation is None else f"{100 * deviation:+.1f} %" + (" OFF" if row.within is False else "")
        measured = "computed only" if row.measured is None else f"{row.measured:.{figure.digits}f} {figure.unit}"
        cells.append((row.texture, figure.label, f"{row.forecast:.{figure.digits}f} {figure.unit}", measured, off))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if place < 2 else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in cells
    ]


def write_csv(path: Path, compared: Sequence[Row]) -> None:
    """Write the figures as CSV, a line each. Raises OSError."""
    columns = ("texture", "quantity", "forecast", "measured", "deviation", "within")
    cells = ((row.texture, row.figure.key, row.forecast, row.measured, row.deviation, row.within) for row in compared)
    write_table(path, columns, (dict(zip(columns, each, strict=True)) for each in cells))


def document(played: Played) -> dict[str, Any]:
    """Return forecast and measured figures of a texture, ready for JSON."""
    texture = played.texture
    return {
        "texture": texture.name,
        "controller": texture.controller,
        "forecast": structs.asdict(texture.forecast),
        "measured": dict(played.measured),
        "report": asdict(played.report),
    }
