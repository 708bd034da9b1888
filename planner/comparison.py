"""Compares forecasts of a plan with measurements of its playback: a table, and the failures."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from msgspec import structs

from vibrocast.planner.page import write_table
from vibrocast.planner.playing import Played

TOLERANCE = 0.1
"""Largest relative deviation of a measurement from its forecast."""


@dataclass(frozen=True)
class Quantity:
    """One of the figures of a Forecast. `held`: whether it must be within TOLERANCE. `digits`: decimals."""

    name: str
    title: str
    unit: str
    held: bool
    digits: int

    def deviation(self, forecast: float, measured: float) -> float:
        """Return the deviation relative to the forecast; levels as amplitudes, so 1 dB is 12 %."""
        if self.unit == "dB":
            return math.pow(10.0, (measured - forecast) / 20) - 1
        return measured / forecast - 1 if forecast else float(measured != forecast)


QUANTITIES = (
    Quantity("payload_bps", "payload", "bit/s", True, 0),
    Quantity("wire_bps", "on the wire", "bit/s", True, 0),
    Quantity("instructions_per_second", "instructions", "1/s", True, 0),
    Quantity("load_percent", "load", "%", True, 2),
    Quantity("snr_db", "SNR", "dB", True, 2),
    Quantity("spqi", "SPQI", "", True, 3),
    Quantity("third_octave_distance_db", "third-octave distance", "dB", True, 2),
    Quantity("error_over_threshold_db", "error re threshold", "dB", True, 2),
    Quantity("delay_ms", "delay", "ms", False, 1),
    Quantity("flash_bytes", "flash", "bytes", False, 0),
    Quantity("ram_bytes", "RAM", "bytes", False, 0),
)
"""All figures. Delays depend on the computer and the link; memory is not measured here."""


@dataclass(frozen=True)
class Row:
    """One figure of one texture. `measured`, `deviation`: None if nothing measured it.

    `within`: whether it is within TOLERANCE; None if nothing measured it, or it need not be."""

    texture: str
    quantity: Quantity
    forecast: float
    measured: float | None
    deviation: float | None
    within: bool | None


def rows(played: Sequence[Played]) -> list[Row]:
    """Return every forecast with its measurement."""
    return [
        _row(each, quantity, forecast)
        for each in played
        for quantity in QUANTITIES
        if (forecast := getattr(each.texture.forecast, quantity.name)) is not None
    ]


def _row(played: Played, quantity: Quantity, forecast: float) -> Row:
    measured = getattr(played.measured, quantity.name, None)
    deviation = None if measured is None else quantity.deviation(forecast, measured)
    within = None if deviation is None or not quantity.held else abs(deviation) <= TOLERANCE
    return Row(played.texture.name, quantity, forecast, measured, deviation, within)


def failures(played: Sequence[Played], compared: Sequence[Row]) -> list[str]:
    """Return a line for each failure: late packets, samples that differ from those sent, and wrong forecasts."""
    found = []
    for each in played:
        if not each.in_time:
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
        f"{row.texture}: {row.quantity.title} deviates by {100 * row.deviation:+.1f} % from its forecast"
        for row in compared
        if row.within is False and row.deviation is not None
    ]
    return found


def lines(compared: Sequence[Row]) -> list[str]:
    """Return a table of all figures as lines of text."""
    header = ("texture", "", "forecast", "measured", "deviation")
    cells = [header]
    for row in compared:
        digits, unit = row.quantity.digits, row.quantity.unit
        measured = "computed only" if row.measured is None else f"{row.measured:.{digits}f} {unit}"
        off = "" if row.deviation is None else f"{100 * row.deviation:+.1f} %"
        forecast = f"{row.forecast:.{digits}f} {unit}"
        cells.append(
            (row.texture, row.quantity.title, forecast, measured, off + (" OFF" if row.within is False else ""))
        )
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
    columns = [each.name for each in fields(Row)]
    write_table(path, columns, ({**vars(row), "quantity": row.quantity.name} for row in compared))


def document(played: Played) -> dict[str, Any]:
    """Return forecast and measured figures of a texture, ready for JSON."""
    texture = played.texture
    return {
        "texture": texture.name,
        "controller": texture.controller,
        "forecast": structs.asdict(texture.forecast),
        "measured": asdict(played.measured),
        "underruns": played.report.underruns,
        "lost_packets": played.report.lost_packets,
        "decoded_as_sent": played.report.decoded_equals_offline,
        "dac_as_computed": played.report.dac_equals_offline,
    }
