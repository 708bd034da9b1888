"""An actuator's constants (vc_actuator of output.h), in integers and in C; run directly, writes those that ship."""

import argparse
import math
import string
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vibrocast.device_protocol.model_image import ACTUATOR_IDENTIFIER, ModelError, ModelImage
from vibrocast.firmware.native_core import float_bits
from vibrocast.output.actuator import (
    LRA,
    PIEZO_STACK,
    VOICE_COIL,
    Actuator,
)

_FIRMWARE = Path(__file__).parents[1] / "firmware"
TABLES = _FIRMWARE / "src" / "controller" / "vc_actuator_tables.c"
HEADER = _FIRMWARE / "include" / "vibrocast" / "actuator_tables.h"
SHIPPED = {
    "piezo_stack": PIEZO_STACK,
    "piezo_stack_12_bits": replace(PIEZO_STACK, dac_bits=12),
    "lra": LRA,
    "voice_coil": VOICE_COIL,
}

_NAME_BYTES = 31
_CRC_BYTES = 4
_LAYOUT = struct.Struct("<32s6IBxhI2iI7iB3x")
"""vc_actuator, as every compiler for a little-endian processor lays it out."""
_PLAIN = string.ascii_letters + string.digits + " _-.,()/+"
"""Characters that stand for themselves in a C string."""
_MAX_DAC_BITS = 16


def constants(actuator: Actuator) -> dict[str, Any]:
    """Return the fields of vc_actuator. Raises ValueError, which names the number that does not fit."""
    name = actuator.name.encode()
    if len(name) > _NAME_BYTES:
        raise ValueError(f"the actuator's name {actuator.name!r} is longer than {_NAME_BYTES} bytes")
    if not 2 <= actuator.dac_bits <= _MAX_DAC_BITS:
        raise ValueError(f"a DAC of {actuator.dac_bits} bits, and it must have 2 to {_MAX_DAC_BITS}")
    lower_hz, upper_hz = actuator.band_hz
    fraction, exponent = math.frexp(actuator.full_scale / actuator.excursion_um)
    return {
        "name": name,
        "stroke_um": float_bits(actuator.stroke_um),
        "volts": float_bits(actuator.volts),
        "lower_hz": float_bits(lower_hz),
        "upper_hz": float_bits(upper_hz),
        "slew_volts_per_second": float_bits(actuator.slew_volts_per_second),
        "dac_rate_hz": actuator.dac_rate_hz,
        "dac_bits": actuator.dac_bits,
        "codes_per_um_exponent": exponent - 31,
        "codes_per_um_mantissa": min(2**31 - 1, round(fraction * 2**31)),
        "code_limit": actuator.code_limit,
        "code_step_limit": min(2 * actuator.full_scale, actuator.code_step_limit),
        "power_limit": min(2**32 - 1, max(1, math.floor(actuator.power_limit * 2**30))),
        "compensation": _section(*actuator.inverse_section()),
    }


def _section(tangent: float, quality: float, weights: Sequence[float]) -> dict[str, Any]:
    """Return the fields of vc_section."""
    divisor = 1 + tangent / quality + tangent**2
    # A bound on the sums of magnitudes that vc_section names: all three ring longer at a higher Q.
    shift = max(0, math.ceil(math.log2((2 + 1.3 * quality) * abs(divisor) / 12)))
    damping, scaled = 1 / quality + tangent, [2.0**shift * weight for weight in weights]
    if not 0 < tangent < 4 or damping >= 32 or sum(map(abs, scaled)) >= 128:
        raise ValueError(
            f"the compensation, a resonance of Q {quality:.3g} at {math.atan(tangent) / math.pi:.3g} of the DAC's rate "
            f"with gains up to {max(weights):.3g}, is out of range: choose another maximum_boost"
        )
    return {
        "tangent": round(tangent * 2**29),
        "damping": round(damping * 2**26),
        "gain": min(2**31 - 1, round(2**30 / divisor)),
        "weight": [round(weight * 2**24) for weight in scaled],
        "shift": shift,
    }


def definition(identifier: str, actuator: Actuator) -> str:
    """Return the C that defines a vc_actuator under this identifier. Raises as `constants`."""
    return f"const vc_actuator {identifier} = {_initialiser(constants(actuator))};\n"


def board_source(actuator: Actuator) -> str:
    """Return a C source that defines `board_actuator`, for a port. Raises as `constants`."""
    return (
        "/* The actuator of a board; written by `vibrocast actuator --c`. */\n"
        f'#include "vibrocast/output.h"\n\n{definition("board_actuator", actuator)}'
    )


def image(actuator: Actuator) -> bytes:
    """Return a packed model image that holds an actuator (docs/reference/protocol.md). Raises as `constants`."""
    fields = constants(actuator)
    section = fields.pop("compensation")
    values = *fields.values(), *(section[name] for name in ("tangent", "damping", "gain")), *section["weight"]
    payload = _LAYOUT.pack(*values, section["shift"])
    lone = ModelImage(ACTUATOR_IDENTIFIER, actuator.name, "1", "", payload)
    # The structure is aligned in flash: bytes of 0 before it, its end is that of the payload, and a CRC follows.
    padding = -(len(lone.pack()) - _CRC_BYTES) % 4
    return replace(lone, payload=bytes(padding) + payload).pack()


def dac_of(payload: bytes) -> tuple[int, int]:
    """Return the bits and the rate in Hz of the DAC of an image's actuator. Raises ModelError for another payload."""
    if len(payload) < _LAYOUT.size:
        raise ModelError("the image holds no actuator; pack it again")
    *_, dac_rate_hz, dac_bits = _LAYOUT.unpack(payload[-_LAYOUT.size :])[:8]
    return dac_bits, dac_rate_hz


def source() -> tuple[str, str]:
    """Return the contents of vc_actuator_tables.c and of its header."""
    command = "written by `python -m vibrocast.output.actuator_constants`"
    tables = [definition(f"vc_{name}", actuator) for name, actuator in SHIPPED.items()]
    declared = "".join(
        f"/* {actuator.name}, DAC of {actuator.dac_bits} bits at {actuator.dac_rate_hz} Hz. */\n"
        f"extern const vc_actuator vc_{name};\n"
        for name, actuator in SHIPPED.items()
    )
    guard = "VIBROCAST_ACTUATOR_TABLES_H"
    return (
        f'/* Actuators that ship; {command}. */\n#include "vibrocast/actuator_tables.h"\n\n' + "\n".join(tables),
        f"/* Actuators that ship; {command}. */\n#ifndef {guard}\n#define {guard}\n\n"
        f'#include "output.h"\n\n#ifdef __cplusplus\nextern "C" {{\n#endif\n'
        f"#ifdef __GNUC__\n#pragma GCC visibility push(default)\n#endif\n\n"
        f"/* cffi: begin */\n{declared}/* cffi: end */\n\n"
        f"#ifdef __GNUC__\n#pragma GCC visibility pop\n#endif\n#ifdef __cplusplus\n}}\n#endif\n\n#endif\n",
    )


def _initialiser(constant: int | bytes | Sequence[int] | Mapping[str, Any], indent: str = "    ") -> str:
    """Return a constant as C."""
    if isinstance(constant, Mapping):
        fields = [f"{indent}.{name} = {_initialiser(value, indent + '    ')},\n" for name, value in constant.items()]
        return "{\n" + "".join(fields) + indent[4:] + "}"
    if isinstance(constant, bytes):
        # Three octal digits end an escape, whatever follows.
        return '"' + "".join(chr(each) if chr(each) in _PLAIN else f"\\{each:03o}" for each in constant) + '"'
    if isinstance(constant, Sequence):
        return "{" + ", ".join(map(str, constant)) + "}"
    return f"{constant}u" if constant >= 2**31 else str(constant)


if __name__ == "__main__":
    argparse.ArgumentParser(description="Write the C tables of the actuators that ship into firmware/.").parse_args()
    for path, text in zip((TABLES, HEADER), source(), strict=True):
        path.write_text(text)
