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


def status(changed: dict[str, Any], flash: Any = ffi.NULL) -> int:
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
    told = library().vc_controller_init(ffi.cast("vc_controller *", memory), settings, flash, dac, 0)
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


@pytest.mark.parametrize(
    ("changed", "is_usable"),
    [
        ({}, True),
        ({"write_bytes": 32}, True),
        ({"write_bytes": 0}, False),
        ({"write_bytes": 3}, False),
        ({"write_bytes": 64}, False),
        ({"record_bytes": 64}, False),
        ({"write_bytes": 8, "slot_bytes": 4}, False),
        ({"slot": [128, 128]}, False),
    ],
)
def test_flash_is_in_whole_writes_of_a_size_that_there_is(changed: dict[str, Any], is_usable: bool) -> None:
    memory = ffi.new("uint8_t[]", b"\xff" * 512)
    change = ffi.callback("int(void *, uint32_t, uint32_t)", lambda *_: 0)
    program = ffi.callback("int(void *, uint32_t, const uint8_t *, uint32_t)", lambda *_: 0)
    places = {"record": [0, 128], "record_bytes": 128, "slot": [256, 384], "slot_bytes": 128, "write_bytes": 1}
    fields = {"base": memory, "erase": change, "program": program, **places, **changed}
    told = status({}, ffi.new("vc_flash *", fields))
    assert told == (library().VC_OK if is_usable else library().VC_BAD_SETTINGS)
