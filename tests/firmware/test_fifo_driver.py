"""The example of an output by a chip with a queue of samples, compiled for this machine, on a model of the chip."""

import ctypes
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vibrocast.firmware import build as building

QUEUE, REFERENCE, CONFIG, STATUS = 64, 0x0, 0x5, 0xC
_TRANSFER = ctypes.CFUNCTYPE(ctypes.c_uint16, ctypes.c_uint16)
_PLAY = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int16), ctypes.c_uint32, ctypes.c_uint, ctypes.c_uint64
)
_COUNT = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint32))


class DacPort(ctypes.Structure):
    """The structure vc_dac_port of settings.h."""

    _fields_ = (
        ("play", _PLAY),
        *((name, ctypes.c_void_p) for name in ("begin", "drop")),
        ("count", _COUNT),
        *((name, ctypes.c_void_p) for name in ("has_failed", "context")),
    )


class Chip:
    """A queue of 64 samples, which plays one at each tick and holds the last; CONFIG chooses what it returns."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.played: list[int] = []
        self.waiting: list[int] = []
        self.config = self.held = 0
        self._kept = _TRANSFER(self.transfer)
        self._library, self.port = library, DacPort.in_dll(library, "vc_fifo_dac")
        library.vc_fifo_start(self._kept)

    def transfer(self, word: int) -> int:
        status = QUEUE - len(self.waiting) if self.config >> 7 & 15 == STATUS else 0
        if word >> 12 == CONFIG:
            self.config = word & 0xFFF
        elif word >> 12 == REFERENCE:
            assert len(self.waiting) < QUEUE, "a sample without room"
            self.waiting.append((word & 0xFFF ^ 0x800) - 0x800)
        return status

    def tick(self, times: int) -> None:
        for _ in range(times):
            self.held = self.waiting.pop(0) if self.waiting else self.held
            self.played.append(self.held)

    def play(self, codes: np.ndarray, now_us: int) -> None:
        block = np.ascontiguousarray(codes, np.int16)
        self.port.play(None, block.ctypes.data_as(ctypes.POINTER(ctypes.c_int16)), len(block), 1, now_us)

    def turn(self, now_us: int) -> None:
        self._library.vc_fifo_turn(ctypes.c_uint64(now_us))

    def counts(self) -> list[int]:
        counted = (ctypes.c_uint32 * 4)()
        self.port.count(None, counted)
        return list(counted)


@pytest.fixture
def chip(tmp_path: Path) -> Chip:
    path = tmp_path / f"fifo{building._LIBRARY_SUFFIX}"
    command = [sys.executable, "-m", "ziglang", "cc", *building.FLAGS, "-shared", "-fPIC", "-Iinclude"]
    subprocess.run([*command, "examples/fifo_driver.c", "-o", str(path)], check=True, cwd=building.ROOT)
    return Chip(ctypes.CDLL(str(path)))


def test_blocks_are_played_whole_and_in_order_also_behind_a_pause_of_1_ms(chip: Chip) -> None:
    codes = np.round(20000 * np.sin(np.arange(1600) / 9)).astype(np.int16)
    codes[-1] = 0
    for at in range(0, 1600, 16):
        chip.play(codes[at : at + 16], at * 125)
        chip.tick(24 if at % 160 == 0 else 15 if at % 160 < 144 else 16)
    chip.tick(100)
    played = np.trim_zeros(np.array(chip.played), "f")
    expected = np.trim_zeros(codes >> 4, "f")
    np.testing.assert_array_equal(played[: len(expected)], expected)
    assert chip.counts() == [0, 0, 0, 0] and chip.held == 0


@pytest.mark.parametrize("ticks_in_1000_blocks", [15_900, 16_100])
def test_a_clock_that_differs_loses_no_more_than_a_sample_at_a_time(chip: Chip, ticks_in_1000_blocks: int) -> None:
    for block in range(3000):
        chip.play(np.arange(16 * block, 16 * block + 16) % 1000 * 16 + 16, 2000 * block)
        chip.tick((block + 1) * ticks_in_1000_blocks // 1000 - block * ticks_in_1000_blocks // 1000)
    steps = np.diff(np.trim_zeros(np.array(chip.played), "f")) % 1000
    assert set(steps) <= {0, 1, 2}
    assert 200 < np.count_nonzero(steps != 1) < 400
    assert chip.counts()[0] == 0


def test_a_chip_that_lost_its_power_is_set_up_again_and_comes_to_rest(chip: Chip) -> None:
    chip.play(np.array([8000, 0]), 0)
    chip.tick(25)
    assert chip.held == 500
    chip.waiting, chip.config = [], 0  # rest is lost
    chip.turn(20_000)
    chip.tick(10)
    assert chip.held == 500
    chip.turn(40_000)
    chip.tick(1)
    assert chip.held == 0 and chip.config >> 7 & 15 == STATUS
