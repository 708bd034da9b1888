"""Actuators by name or from a TOML file."""

from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from vibrocast.files import InputFileError
from vibrocast.output.actuator import ACTUATORS, Actuator
from vibrocast.output.actuator_constants import constants
from vibrocast.toml_tables import Table, read_toml


class ActuatorFileError(InputFileError):
    """A file that describes no actuator; the message says what to correct."""


def find(name_or_path: str | Path) -> Actuator:
    """Return the actuator of a name in ACTUATORS, or the one that a TOML file describes: see docs/harness.md.

    The file has the keys of an entry of `[[actuators]]` at its top, or one such entry, as `vibrocast measure` writes
    it. Raises ActuatorFileError, and OSError where the file cannot be read.
    """
    if str(name_or_path) in ACTUATORS:
        return ACTUATORS[str(name_or_path)]
    path = Path(name_or_path)
    if not path.exists():
        raise ActuatorFileError(
            f"{name_or_path}: no actuator of that name and no file; give one of {', '.join(ACTUATORS)}, or a TOML file"
        )
    document = read_toml(path, "description of an actuator", ActuatorFileError)
    entries = document.get("actuators", [document])
    if not (isinstance(entries, list) and len(entries) == 1 and isinstance(entries[0], dict)):
        raise ActuatorFileError(f"{path}: not one actuator; give a file with its keys, or with one table [[actuators]]")
    # Where it is installed is no property of the actuator.
    keys = {key: value for key, value in entries[0].items() if key not in ("controller", "channel")}
    table = Table(path, "actuator", keys, ActuatorFileError)
    found = of_table(table)
    table.end()
    return found


def of_table(table: Table) -> Actuator:
    """Take an actuator out of a table: `model`, or all of its numbers. Raises the table's error."""
    model = table.word("model", ACTUATORS, None)
    base = ACTUATORS[model] if model else None

    def default(key: str) -> Any:
        return getattr(base, key) if base else MISSING

    required = ("stroke_um", "volts", "corner_hz", "slew_volts_per_second", "volts_limit", "power_limit")
    given: dict[str, Any] = {key: table.number(key, default(key)) for key in required}
    given["name"] = table.text("name", default("name"))
    standard = {each.name: each.default for each in fields(Actuator)}
    given["quality"] = table.number("quality", base.quality if base else None)
    given["maximum_boost"] = table.number("maximum_boost", base.maximum_boost if base else standard["maximum_boost"])
    given["dac_bits"] = table.whole("dac_bits", 8, 16, base.dac_bits if base else standard["dac_bits"])
    rate_hz = base.dac_rate_hz if base else standard["dac_rate_hz"]
    given["dac_rate_hz"] = table.whole("dac_rate_hz", 100, 1_000_000, rate_hz)
    actuator = Actuator(**given)
    try:
        constants(actuator)
    except (ValueError, OverflowError) as error:
        raise table.reject(f"no controller can drive this actuator: {error}; correct its numbers") from error
    return actuator
