"""Actuators in integers: the tables that ship are those of the descriptions, and no compensation can overflow."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from tests.conftest import texture
from vibrocast.codec.encoding import encode_recording
from vibrocast.harness.boards.host_process import HostProcess
from vibrocast.host import playback
from vibrocast.host.devices import open_session
from vibrocast.output.actuator import (
    LRA,
    PIEZO_STACK,
    VOICE_COIL,
    Actuator,
    Filter,
)
from vibrocast.output.actuator_constants import HEADER, TABLES, board_source, constants, source

DESCRIBED = [
    PIEZO_STACK,
    LRA,
    VOICE_COIL,
    replace(PIEZO_STACK, dac_rate_hz=1000),
    replace(PIEZO_STACK, dac_rate_hz=1_000_000),
    replace(PIEZO_STACK, corner_hz=1e9),
    replace(LRA, quality=30.0, maximum_boost=1.0),
    replace(LRA, quality=0.7, maximum_boost=2.0),
    replace(LRA, corner_hz=2000.0, quality=50.0),
    replace(VOICE_COIL, dac_rate_hz=200_000),
]


def outputs(actuator: Actuator) -> list[Filter]:
    """The filters from the input of an actuator's section to its outputs, from the integers."""
    section = constants(actuator)["compensation"]
    g, damping, gain = section["tangent"] / 2**29, section["damping"] / 2**26, section["gain"] / 2**30
    denominator = np.array([1 + g * (damping - g) + g**2, 2 * g**2 - 2, 1 - g * (damping - g) + g**2])
    high, band, low = np.array([1, -2, 1]), g * np.array([1, 0, -1]), g**2 * np.array([1, 2, 1])
    return [(high / gain, denominator), (band, denominator), (low, denominator)]


@pytest.mark.parametrize("actuator", DESCRIBED, ids=lambda each: f"{each.name}-{each.corner_hz}-{each.dac_rate_hz}")
def test_section_has_room_to_ring(actuator: Actuator) -> None:
    impulse = np.zeros(100_000)
    impulse[0] = 1.0
    shift = constants(actuator)["compensation"]["shift"]
    for filter_ in outputs(actuator):
        assert np.abs(signal.lfilter(*filter_, impulse)).sum() <= 12 * 2**shift


@pytest.mark.parametrize(
    ("actuator", "reason"),
    [
        (replace(LRA, name="x" * 32), "name"),
        (replace(LRA, dac_bits=17), "17 bits"),
        (replace(LRA, corner_hz=4000.0), "compensation"),
        (replace(LRA, quality=1e6), "compensation"),
        (replace(LRA, quality=0.01), "compensation"),
        (replace(LRA, maximum_boost=100.0), "maximum_boost"),
    ],
)
def test_values_that_do_not_fit_are_rejected(actuator: Actuator, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        constants(actuator)


def test_firmware_plays_by_a_boards_own_source(tmp_path: Path) -> None:
    """Its name has what C could take for something else."""
    actuator = replace(LRA, name='q"\\ü??/1*/', corner_hz=161.3, power_limit=0.01)
    source = tmp_path / "own.c"
    source.write_text(board_source(actuator))
    stream = encode_recording(texture(np.sin(np.arange(1000) / 3)), live=True).stream
    with HostProcess(actuator=source) as process, open_session(f"serial:{process.name}", actuator=actuator) as session:
        assert session.controller.description.actuator.name == actuator.name
        assert playback.play(session, "sine", stream).report.dac_equals_offline is True


def test_tables_are_what_their_command_writes() -> None:
    tables, header = source()
    assert TABLES.read_text() == tables
    assert HEADER.read_text() == header
