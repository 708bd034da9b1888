"""Actuators by name or from a TOML file."""

from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import Annotated

from vibrocast.errors import InputError, located
from vibrocast.output.actuator import ACTUATORS, Actuator
from vibrocast.output.actuator_constants import constants
from vibrocast.toml_tables import Table, Text, convert, one_of, read_toml, within


class ActuatorTable(Table, frozen=True, kw_only=True):
    """An entry of `[[actuators]]`: `model` and the numbers that differ from it, or all numbers; and its channel."""

    model: Annotated[str, one_of(ACTUATORS)] | None = None
    name: Text | None = None
    stroke_um: Annotated[float, within(0.1, 20_000, "stroke from end to end in um")] | None = None
    volts: Annotated[float, within(0.1, 2_000, "voltage range in V")] | None = None
    corner_hz: Annotated[float, within(2, 5_000, "-3 dB frequency or resonance in Hz")] | None = None
    quality: Annotated[float, within(0.1, 300, "Q of the resonance")] | None = None
    slew_volts_per_second: Annotated[float, within(10, 1e9, "slew limit in V/s")] | None = None
    volts_limit: Annotated[float, within(0.05, 2_000, "voltage limit from rest in V")] | None = None
    power_limit: Annotated[float, within(1e-4, 1, "mean of the squared drive, full scale = 1")] | None = None
    dac_bits: Annotated[int, within(8, 16, "bits of the DAC")] | None = None
    dac_rate_hz: Annotated[int, within(100, 1_000_000, "rate of the DAC in Hz")] | None = None
    maximum_boost: Annotated[float, within(1e-3, 1e3, "greatest gain of the compensation")] | None = None
    controller: Text | None = None
    channel: Annotated[int, within(1, 16, "channel of the controller")] | None = None

    def actuator(self) -> Actuator:
        """Return the actuator. Raises ValueError if a number is missing, or if no controller can drive it."""
        given = {key.name: value for key in fields(Actuator) if (value := getattr(self, key.name)) is not None}
        values = {"quality": None, **(asdict(ACTUATORS[self.model]) if self.model else {}), **given}
        if missing := [key.name for key in fields(Actuator) if key.default is MISSING and key.name not in values]:
            raise ValueError(f"{missing[0]} is missing; give it, or a model that has it: {', '.join(ACTUATORS)}")
        actuator = Actuator(**values)
        try:
            constants(actuator)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"no controller can drive this actuator: {error}; correct its numbers") from error
        return actuator


def find(name_or_path: str | Path) -> Actuator:
    """Return the actuator of a name in ACTUATORS, or of a TOML file (docs/reference/toml_files.md).

    The file has the keys of an entry of `[[actuators]]` at its top, or one such entry, as `vibrocast measure` writes
    it. Raises InputError, and OSError if the file cannot be read.
    """
    if str(name_or_path) in ACTUATORS:
        return ACTUATORS[str(name_or_path)]
    path = Path(name_or_path)
    if not path.exists():
        raise InputError(
            f"{name_or_path}: no actuator of that name and no file; give one of {', '.join(ACTUATORS)}, or a TOML file"
        )
    with located(path):
        document = read_toml(path, "description of an actuator")
        entries = document.get("actuators", [document])
        if not (isinstance(entries, list) and len(entries) == 1):
            raise ValueError("not one actuator; give a file with its keys, or with one table [[actuators]]")
        return convert(entries[0], ActuatorTable).actuator()
