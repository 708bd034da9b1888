"""The processor time that encoding and decoding take, and the processor that took it."""

import math
import platform
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from timeit import Timer
from typing import TypeVar

T = TypeVar("T")

MIN_S = 0.01
"""Shorter work is timed in several runs at a time that together take about as long, far above a clock's step."""


def time_coding(
    encode: Callable[[], T], decode: Callable[[T], object], samples: int, repeats: int
) -> tuple[float, float]:
    """Return the seconds that encoding and decoding take for each million samples, all channels together.

    Processor seconds of this process, all its threads together, as one core would need; the median of `repeats` after
    a first run, which is not counted. `samples`: how many one run codes, all channels together.
    """
    coded = encode()
    decode(coded)
    megasamples = samples / 1e6
    return (
        _processor_seconds(encode, repeats) / megasamples,
        _processor_seconds(lambda: decode(coded), repeats) / megasamples,
    )


def _processor_seconds(work: Callable[[], object], repeats: int) -> float:
    timer = Timer(work, timer=time.process_time)
    once = timer.timeit(1)
    if once >= MIN_S:
        return median([once, *timer.repeat(repeats - 1, 1)])
    runs = math.ceil(MIN_S / max(once, 1e-6))
    return median(timer.repeat(repeats, runs)) / runs


def cpu_name() -> str:
    """Return the system's name of its processor."""
    described = Path("/proc/cpuinfo")
    lines = described.read_text(encoding="utf-8").splitlines() if described.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return (names or [platform.processor() or platform.machine()])[0]
