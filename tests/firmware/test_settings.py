"""The settings of a controller: what no controller can have is rejected at its start, and nothing is touched."""

from dataclasses import replace
from typing import Any

import pytest

from vibrocast.firmware.native_core import ffi, library
from vibrocast.output.actuator import LRA
from vibrocast.output.actuator_constants import constants

ACTUATOR = constants(replace(LRA, dac_rate_hz=3000))
SECTION = ACTUATOR["compensation"]
USABLE: dict[str, Any] = {"build": b"a", "hardware": b"b", "watchdog_ms": 50}


def status(changed: dict[str, Any]) -> int:
    """Return what vc_controller_init says of settings that differ so from usable ones."""
    given = {**USABLE, **changed}
    texts: dict[str, Any] = {
        name: ffi.new("char[]", given[name]) for name in ("build", "hardware", "serial_number") if name in given
    }
    actuator = ffi.new("vc_actuator *", {name: given.get(name, value) for name, value in ACTUATOR.items()})
    fields = {**texts, "actuator": actuator, "watchdog_ms": given["watchdog_ms"]}
    settings = ffi.new("vc_controller_settings *", fields)
    memory = ffi.new("int64_t[]", library().vc_controller_size() // 8)
    dac = ffi.new("vc_dac_port *")
    told = library().vc_controller_init(ffi.cast("vc_controller *", memory), settings, ffi.NULL, dac, 0)
    assert any(memory) == (told == 0)
    return int(told)


def test_usable_settings_are_taken() -> None:
    assert status({}) == library().VC_OK
    assert status({"build": b"x" * 63, "serial_number": b"y" * 31}) == library().VC_OK


@pytest.mark.parametrize(
    "changed",
    [
        {"build": b"x" * 64},
        {"hardware": b"x" * 4500},
        {"serial_number": b"y" * 32},
        {"watchdog_ms": 49},
        {"watchdog_ms": 0},
        {"dac_rate_hz": 0},
        {"dac_bits": 1},
        {"dac_bits": 17},
        {"name": b"x" * 32},
        {"stroke_um": 0},
        {"volts": 0xFF800000},
        {"lower_hz": ACTUATOR["upper_hz"]},
        {"codes_per_um_mantissa": 2**30 - 1},
        {"code_limit": 2**15},
        {"code_step_limit": 0},
        {"power_limit": 0},
        {"compensation": SECTION | {"damping": SECTION["tangent"] >> 3}},
        {"compensation": SECTION | {"gain": 2 * SECTION["gain"]}},
        {"compensation": SECTION | {"weight": [2**29] * 4}},
        {"compensation": SECTION | {"shift": 32}},
    ],
)
def test_settings_that_no_controller_can_have_are_rejected(changed: dict[str, Any]) -> None:
    assert status(changed) == library().VC_BAD_SETTINGS
