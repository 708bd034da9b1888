"""What decoding costs a controller, from the tables that `python -m evaluation.firmware` measures."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

import evaluation

_TABLES = Path(evaluation.__file__).parent / "data"
_KERNELS = "DSP instructions"
MOST_LOAD_PERCENT = 60.0
"""Of a processor, by instructions: on a Cortex-M4 an instruction of these decoders takes some 1.3 cycles, flash memory
adds wait states, and frames come when they come."""


@dataclass(frozen=True)
class DecoderCost:
    """Of one decoder on one core.

    `bits`, `instructions`: a line through what was measured on textures, instructions per sample of one channel =
    instructions[0] + instructions[1] * bits per sample, and at least `least_instructions`. `flash_bytes`: code and
    model. `state_bytes`: RAM of a decoder for 1, 2 and 4 channels. `stack_bytes`: the most that was used.
    """

    instructions: tuple[float, float]
    least_instructions: float
    flash_bytes: int
    state_bytes: tuple[int, int, int]
    stack_bytes: int

    def instructions_per_second(self, bits_per_sample: float, rate_hz: float, channels: int) -> float:
        """Return what decoding takes, where a sample of each channel takes so many bits."""
        offset, slope = self.instructions
        return max(self.least_instructions, offset + slope * bits_per_sample) * rate_hz * channels

    def ram_bytes(self, channels: int) -> int:
        """Return state and stack; state grows by what each channel adds."""
        return round(_line((1, 2, 4), self.state_bytes, channels)) + self.stack_bytes


@dataclass(frozen=True)
class RestCost:
    """Of a controller but for decoding: instructions a second, flash and RAM."""

    instructions_per_second: float
    flash_bytes: int
    ram_bytes: int


@cache
def decoder_cost(decoder: str, core: str) -> DecoderCost | None:
    """Return the cost of a codec or model by its name, None where it has not been measured on that core."""
    loads = [
        row for row in _rows("loads") if (row["decoder"], row["core"], row["kernels"]) == (decoder, core, _KERNELS)
    ]
    sizes = [row for row in _rows("sizes") if (row["decoder"], row["kernels"]) == (decoder, _KERNELS)]
    if not loads or not sizes:
        return None
    bits = [float(row["bits_per_sample"]) for row in loads]
    instructions = [float(row["instructions"]) for row in loads]
    slope, offset = np.polyfit(bits, instructions, 1)
    one, two, four = (int(sizes[0][f"state_{channels}_bytes"]) for channels in (1, 2, 4))
    return DecoderCost(
        instructions=(float(offset), float(slope)),
        least_instructions=min(instructions),
        flash_bytes=int(sizes[0]["code_bytes"]) + int(sizes[0]["image_bytes"]),
        state_bytes=(one, two, four),
        stack_bytes=max(int(row["stack_bytes"]) for row in loads),
    )


@cache
def rest_cost(channels: int) -> RestCost:
    """Return what the firmware takes besides decoding: messages, buffer, output stage; a line over the channels."""
    rows = list(_rows("controller"))
    measured = [int(row["channels"]) for row in rows]

    def of(values: list[float]) -> float:
        return _line(measured, values, channels)

    return RestCost(
        of([float(row["instructions"]) - float(row["decoding"]) for row in rows]),
        round(of([float(row["flash_bytes"]) for row in rows])),
        round(of([float(row["ram_bytes"]) for row in rows])),
    )


def _line(x: tuple[int, ...] | list[int], y: tuple[int, ...] | list[float], at: float) -> float:
    return float(np.polyval(np.polyfit(x, y, 1), at))


def _rows(table: str) -> Iterator[dict[str, str]]:
    with (_TABLES / f"firmware_{table}.csv").open(newline="", encoding="utf-8") as file:
        yield from csv.DictReader(file)
