"""The sensitivity of a sensor as its data sheet states it: `10.2mV/g`, `0.3mV/um`, `256/g`."""

import re
from dataclasses import dataclass

from vibrocast.textures.recording import INPUT_UNITS, VOLTS, TextureError, known_unit

EXAMPLES = "10.2mV/g, 1mV/(m/s^2), 0.3mV/um; 256/g for counts"
_FORM = re.compile(r"\s*(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+)\s*(uV|mV|V)?\s*/\s*(\(.+\)|[^()]+?)\s*")
_HIGHEST = 1e9


@dataclass(frozen=True)
class Sensitivity:
    """The volts or counts that a sensor gives for one unit of acceleration or length.

    Attributes:
        per_unit: Volts or counts for one `unit`.
        unit: "m/s^2" or "um".
        in_volts: Whether `per_unit` is in volts; otherwise it counts what a digital sensor sends.
        text: As it was written.
    """

    per_unit: float
    unit: str
    in_volts: bool
    text: str


def parse(text: str) -> Sensitivity:
    """Return the sensitivity that a text states, such as EXAMPLES. Raises TextureError."""
    match = _FORM.fullmatch(text)
    if match is None:
        raise TextureError(f"{text!r} is no sensitivity; write one such as {EXAMPLES}")
    number, volts, unit_text = match.groups()
    unit, factor = INPUT_UNITS[known_unit(unit_text.strip("()").strip(), repr(text))]
    if unit == "full scale":
        raise TextureError(f"{text!r} is per {unit_text}; write it per unit of acceleration or length: {EXAMPLES}")
    per_unit = float(number) * VOLTS.get(volts or "", 1.0) / factor
    if not 1 / _HIGHEST < per_unit < _HIGHEST:
        raise TextureError(f"{text!r} is the sensitivity of no sensor; write one such as {EXAMPLES}")
    return Sensitivity(per_unit, unit, volts is not None, text.strip())
