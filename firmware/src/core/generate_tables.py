"""Writes vc_constant_tables.c, the mathematical tables of the core: `python firmware/src/core/generate_tables.py`."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path


def detection_threshold_db(frequency_hz: float) -> float:
    """Return the detection threshold of acceleration, in dB above its least value, at 250 Hz; 30 at most.

    The formula is that of vibromaf (signal/perception.py), by which ST-SIM and SPQI weigh spectra.
    """
    return min(30.0, 62 * (math.log10(frequency_hz / 550 + 300 / 550) / math.log10(300 / 550)) ** 2)


def resampling_kernel(crossings: float) -> float:
    """Return the resampler's low-pass at a number of zero crossings of its plain sinc: Kaiser window, stop band 60 dB.

    Its -6 dB point is 0.9 of half the rate whose samples lie a crossing apart. Kaiser and Schafer, "On the use of the
    I0-sinh window for spectrum analysis", 1980: beta = 0.1102 (60 - 8.7).
    """
    beta, ends = 0.1102 * (60 - 8.7), 8
    window = bessel_i0(beta * math.sqrt(1 - (crossings / ends) ** 2)) / bessel_i0(beta)
    phase = 0.9 * math.pi * crossings
    return window * (math.sin(phase) / phase if phase else 1.0)


def octave_filter(sample: int) -> float:
    """Return a tap of the low-pass before decimation by two: Kaiser window as above.

    In parts of half the rate it passes up to 0.35 and stops from 0.435 on, 60 dB down.
    """
    beta, ends = 0.1102 * (60 - 8.7), 43
    window = bessel_i0(beta * math.sqrt(1 - (sample / ends) ** 2)) / bessel_i0(beta)
    phase = 0.3925 * math.pi * sample
    return window * (math.sin(phase) / phase if phase else 1.0)


def bessel_i0(x: float) -> float:
    """Return the modified Bessel function of order 0 by its series (Abramowitz and Stegun, 9.6.12)."""
    return sum((x / 2) ** (2 * k) / math.factorial(k) ** 2 for k in range(40))


TABLES: dict[str, tuple[str, Sequence[float]]] = {
    "vc_cosine": ("int32_t", [2**24 * math.cos(2 * math.pi * i / 1024) for i in range(1024)]),
    "vc_stretch": ("int16_t", [256 * math.log((i + 0.5) / (2047.5 - i)) for i in range(2048)]),
    "vc_squash": ("uint16_t", [65536 / (1 + math.exp(-(4 * i - 2046) / 256)) for i in range(1024)]),
    "vc_rate": ("uint16_t", [256 * math.log2(1 + math.exp((2046 - 4 * i) / 256)) for i in range(1024)]),
    "vc_learning": ("uint16_t", [65536 / (i + 1.6) for i in range(256)]),
    "vc_share": ("uint16_t", [79 * 512 // (k + 1) for k in range(128)]),
    "vc_ratio": ("uint16_t", [16 * 2 ** (i / 16) for i in range(65)]),
    "vc_ratio_class": ("uint8_t", [sum(3 * i >= 16 * third for third in range(3, 10)) for i in range(65)]),
    "vc_mean_rate": ("uint16_t", [0, *(4096 / i for i in range(1, 25))]),
    # In 1/256 octave of amplitude, at eighths of an octave from 16 Hz to 2048 Hz.
    "vc_slp_threshold": (
        "uint16_t",
        [256 * detection_threshold_db(2 ** (4 + i / 8)) / (20 * math.log10(2)) for i in range(57)],
    ),
    "vc_dct_cosine": ("int32_t", [2**24 * math.cos(2 * math.pi * i / 4096) for i in range(1025)]),
    "vc_initial": (
        "uint16_t",
        [65536 / (1 + math.exp(-(16 * (i if i < 128 else i - 256) + 2) / 256)) for i in range(256)],
    ),
    # sqrt(x) + 1.5 in 1/8 at steps of 2^25 of x, times 2^12, and its rise over the step in 1/8; from x = 2^30 on.
    "vc_root": (
        "uint32_t",
        [0] * 32
        + [
            (math.floor(8 * math.sqrt(i << 25) + 12) << 12) + round(8 * (math.sqrt((i + 1) << 25) - math.sqrt(i << 25)))
            for i in range(32, 128)
        ],
    ),
    "vc_dct_exponential": ("uint32_t", [2 ** (30 + i / 256) for i in range(257)]),
    # 256 steps a crossing; 0 at the window's end and one step after it, so that it falls to 0 without a jump.
    "vc_resampling_kernel": ("int32_t", [2**23 * resampling_kernel(i / 256) for i in range(2048)] + [0, 0]),
    "vc_octave_filter": ("int32_t", [2**23 * octave_filter(i) for i in range(43)]),
}


def table_source(name: str, kind: str, values: Sequence[float]) -> str:
    """Return the C definition of one table, ten rounded values a line."""
    integers = [str(round(value)) for value in values]
    lines = [", ".join(integers[start : start + 10]) for start in range(0, len(integers), 10)]
    return f"const {kind} {name}[{len(values)}] = {{\n    " + ",\n    ".join(lines) + "};\n"


if __name__ == "__main__":
    argparse.ArgumentParser(description="Write vc_constant_tables.c, the mathematical tables of the core.").parse_args()
    definitions = "\n".join(table_source(name, kind, values) for name, (kind, values) in TABLES.items())
    names = ("dct_model", "mdct_state", "output_memory", "profile_memory", "slp_frame")
    includes = "".join(f'#include "vc_{name}.h"\n' for name in names)
    head = f"/* Mathematical tables; written by generate_tables.py. */\n{includes}\n"
    Path(__file__).with_name("vc_constant_tables.c").write_text(head + definitions)
