"""The haptic driver's output, compiled for this machine: its two modes, as writes to registers."""

import ctypes
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

from vibrocast.firmware import build as building

WAVEFORM, ENVELOPE = 0, 1
MODE, INPUT, RATED, CLAMP, FEEDBACK, CONTROL_3 = 0x01, 0x02, 0x16, 0x17, 0x1A, 0x1D
RATE_HZ, PERIOD = 8000, 40  # samples in 5 ms
_WRITE = ctypes.CFUNCTYPE(None, ctypes.c_uint8, ctypes.c_uint8)


class Driver(ctypes.Structure):
    """The structure vc_drv260x of firmware/ports/drv260x/drv260x.h."""

    _fields_ = (("mode", ctypes.c_int), ("rated", ctypes.c_uint8), ("clamp", ctypes.c_uint8), ("write", _WRITE))


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """Return the driver's code."""
    path = tmp_path_factory.mktemp("drv260x") / f"drv260x{building._LIBRARY_SUFFIX}"
    source = building.ROOT / "ports" / "drv260x" / "drv260x.c"
    command = [sys.executable, "-m", "ziglang", "cc", *building.FLAGS, "-shared", "-fPIC"]
    subprocess.run([*command, str(source), "-o", str(path)], check=True)
    return ctypes.CDLL(str(path))


@pytest.fixture
def played(library: ctypes.CDLL) -> Callable[[int, list[int]], list[tuple[int, int]]]:
    """Return a function that plays samples in a mode, and returns the writes behind those of the start."""

    def play(mode: int, samples: list[int]) -> list[tuple[int, int]]:
        written: list[tuple[int, int]] = []
        driver = Driver(mode, 0x50, 0x90, _WRITE(lambda address, value: written.append((address, value))))
        library.vc_drv260x_start(ctypes.byref(driver), RATE_HZ)
        start = dict(written)
        assert (start[INPUT], start[RATED], start[CLAMP], start[MODE]) == (0, 0x50, 0x90, 5)
        assert written[-1] == (MODE, 5), "it leaves standby last"
        # N_ERM_LRA is bit 7 of 0x1A; ERM_OPEN_LOOP is bit 5 of 0x1D, whose bit 3 would make the input unsigned.
        assert (start[FEEDBACK] >> 7, start[CONTROL_3]) == ((1, 0) if mode == ENVELOPE else (0, 1 << 5))
        written.clear()
        for sample in samples:
            library.vc_drv260x_sample(ctypes.c_int32(sample))
        assert {address for address, _ in written} <= {INPUT}
        return written

    return play


def test_a_waveform_is_written_sample_by_sample(played: Callable[[int, list[int]], list[tuple[int, int]]]) -> None:
    written = played(WAVEFORM, [0, 5, 5, -5, 127, -128, 0])
    assert [np.uint8(value).astype(np.int8) for _, value in written] == [5, -5, 127, -127, 0]


def test_an_envelope_is_the_highest_magnitude_of_each_period_and_at_most_full_drive(
    played: Callable[[int, list[int]], list[tuple[int, int]]],
) -> None:
    time_s = np.arange(8 * PERIOD) / RATE_HZ
    level = np.repeat([0, 100, 100, 40, 40, 40, 0, 0], PERIOD)
    wave = np.round(level * np.sin(2 * np.pi * 200 * time_s)).astype(int).tolist()
    assert [value for _, value in played(ENVELOPE, wave)] == [100, 40, 0]
    assert [value for _, value in played(ENVELOPE, [-128] * PERIOD + [0] * PERIOD)] == [127, 0]
