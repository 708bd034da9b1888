"""The haptic driver's output, compiled for this machine: its two modes, as writes to registers."""

import ctypes
import itertools
import subprocess
import sys
from collections.abc import Callable, Container

import numpy as np
import pytest

from vibrocast.firmware import build as building

WAVEFORM, ENVELOPE = 0, 1
MODE, INPUT, RATED, CLAMP, FEEDBACK, CONTROL_3 = 0x01, 0x02, 0x16, 0x17, 0x1A, 0x1D
RATE_HZ, PERIOD = 8000, 40  # samples in 5 ms
REFRESH, RETRY = 320, 80  # samples in 40 and 10 ms
_WRITE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_uint8, ctypes.c_uint8)
Play = Callable[..., list[tuple[int, int]]]


class Counts(ctypes.Structure):
    """The structure vc_output_counts of settings.h."""

    _fields_ = tuple((name, ctypes.c_uint32) for name in ("gaps", "late_samples", "refused", "restarts"))


class Driver(ctypes.Structure):
    """The structure vc_drv260x of firmware/ports/drv260x/drv260x.h."""

    _fields_ = (
        ("mode", ctypes.c_int),
        ("rated", ctypes.c_uint8),
        ("clamp", ctypes.c_uint8),
        ("write", _WRITE),
        ("counts", ctypes.POINTER(Counts)),
    )


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """Return the driver's code."""
    path = tmp_path_factory.mktemp("drv260x") / f"drv260x{building._LIBRARY_SUFFIX}"
    source = building.ROOT / "ports" / "drv260x" / "drv260x.c"
    command = [sys.executable, "-m", "ziglang", "cc", *building.FLAGS, "-shared", "-fPIC", "-Iinclude"]
    subprocess.run([*command, str(source), "-o", str(path)], check=True, cwd=building.ROOT)
    return ctypes.CDLL(str(path))


@pytest.fixture
def played(library: ctypes.CDLL) -> Play:
    """Return a function that plays samples in a mode, and returns the writes behind those of the set-up.

    Writes of the numbers in `refused` are not taken.
    """

    def play(
        mode: int, samples: list[int], refused: Container[int] = (), counts: Counts | None = None
    ) -> list[tuple[int, int]]:
        written: list[tuple[int, int]] = []
        asked = itertools.count()

        def write(address: int, value: int) -> int:
            if next(asked) in refused:
                return 0
            written.append((address, value))
            return 1

        kept = counts or Counts()
        driver = Driver(mode, 0x50, 0x90, _WRITE(write), ctypes.pointer(kept))
        library.vc_drv260x_start(ctypes.byref(driver), RATE_HZ)
        for sample in [0] * PERIOD + samples:
            library.vc_drv260x_sample(ctypes.c_int32(sample))
        start = dict(written[:6])
        assert (start[INPUT], start[RATED], start[CLAMP], start[MODE]) == (0, 0x50, 0x90, 5)
        assert written[5] == (MODE, 5), "it leaves standby last"
        # N_ERM_LRA is bit 7 of 0x1A; ERM_OPEN_LOOP is bit 5 of 0x1D, whose bit 3 would make the input unsigned.
        assert (start[FEEDBACK] >> 7, start[CONTROL_3]) == ((1, 0) if mode == ENVELOPE else (0, 1 << 5))
        return written[6:]

    return play


def values(written: list[tuple[int, int]]) -> list[int]:
    """Return the inputs that were written, each once until another one comes."""
    inputs = [int(np.uint8(value).astype(np.int8)) for address, value in written if address == INPUT]
    return [value for value, _ in itertools.groupby(inputs)]


def test_a_waveform_is_written_sample_by_sample(played: Play) -> None:
    assert values(played(WAVEFORM, [0, 5, 5, -5, 127, -128, 0])) == [5, -5, 127, -127, 0]


def test_an_envelope_is_the_highest_magnitude_of_each_period_and_at_most_full_drive(played: Play) -> None:
    time_s = np.arange(8 * PERIOD) / RATE_HZ
    level = np.repeat([0, 100, 100, 40, 40, 40, 0, 0], PERIOD)
    wave = np.round(level * np.sin(2 * np.pi * 200 * time_s)).astype(int).tolist()
    assert values(played(ENVELOPE, wave)) == [100, 40, 0]
    assert values(played(ENVELOPE, [-128] * PERIOD + [0] * PERIOD)) == [127, 0]


def test_the_value_and_every_register_of_the_set_up_are_sent_again(played: Play) -> None:
    written = played(WAVEFORM, [7] * 12 * REFRESH)
    assert written.count((INPUT, 7)) >= 6
    assert {address for address, _ in written} == {INPUT, RATED, CLAMP, FEEDBACK, CONTROL_3, MODE}
    # Also where every sample differs, in place of one of them.
    assert (MODE, 5) in played(WAVEFORM, [5, -5] * 6 * REFRESH)


@pytest.mark.parametrize("lost", range(6, 10))
def test_no_lost_write_leaves_the_actuator_driven(played: Play, lost: int) -> None:
    """The last change, to rest, may be the one that is lost."""
    counts = Counts()
    written = played(WAVEFORM, [60, 57, 0] + [0] * 2 * REFRESH, {lost}, counts)
    assert values(written)[-1] == 0
    assert (counts.refused, counts.restarts) == (1, 1) or (lost == 9 and counts.refused <= 1)


def test_a_chip_without_an_answer_is_asked_every_10_ms_and_set_up_once_it_answers(played: Play) -> None:
    counts = Counts()
    written = played(WAVEFORM, [60] * 10 * RETRY, range(7, 12), counts)
    assert (counts.refused, counts.restarts) == (5, 1)
    assert written[-1] == (INPUT, 60) or (INPUT, 60) in written[-3:]
    assert [address for address, _ in written].count(MODE) >= 1
