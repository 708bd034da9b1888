"""The cost of decoding on a controller, from the tables that `python -m studies.firmware` measures."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import PROFILE_UNIT
from vibrocast.host import devices

_TABLES = Path(__file__).parent / "data"
_KERNELS = "DSP instructions"
_MEASURED_CORE = "M4F"
MAX_LOAD_PERCENT = 60.0
"""Highest load of a processor, by instructions. On a Cortex-M4 an instruction of these decoders takes some 1.3 cycles,
flash memory adds wait states, and frames may arrive at any time."""


@cache
def board_cores() -> dict[str, str]:
    """Return the processors of the controllers whose whole load `studies.firmware` measures, by address.

    The first of a kind stands for others.
    """
    cores = {address: devices.firmware_device(address).core for address in devices.FIRMWARE}
    return {address: core for address, core in cores.items() if core is not None}


QUIET_SAMPLES = 16


def quiet_part(decoded: NDArray[np.int16]) -> float:
    """Return the share of runs of QUIET_SAMPLES decoded samples (n, channels) that are all 0.

    Decoders skip blocks without a signal quickly.
    """
    whole = len(decoded) // QUIET_SAMPLES * QUIET_SAMPLES
    stretches = decoded[:whole].reshape(-1, QUIET_SAMPLES, decoded.shape[1])
    return float(np.mean(~stretches.any(axis=1))) if whole else 0.0


@dataclass(frozen=True)
class DecoderCost:
    """The cost of one decoder on one core.

    `instructions`: for a quiet sample of one channel, for another sample, and for each bit; fitted to measurements on
    textures. `flash_bytes`: code and model. `state_bytes`: RAM of a decoder for 1, 2 and 4 channels. `stack_bytes`: the
    most that was used.
    """

    instructions: tuple[float, float, float]
    flash_bytes: int
    state_bytes: tuple[int, int, int]
    stack_bytes: int

    def instructions_per_second(self, bits_per_sample: float, quiet: float, rate_hz: float, channels: int) -> float:
        """Return the instructions per second. `bits_per_sample`: of each channel; `quiet`: as quiet_part."""
        of_quiet, of_other, of_bit = self.instructions
        return (of_quiet * quiet + of_other * (1 - quiet) + of_bit * bits_per_sample) * rate_hz * channels

    def ram_bytes(self, channels: int) -> int:
        """Return state and stack; the state is linear in the channels."""
        return round(_line((1, 2, 4), self.state_bytes, channels)) + self.stack_bytes


@cache
def decoder_cost(decoder: str, core: str, block: str | None = None) -> DecoderCost | None:
    """Return the cost of a codec or model by its name, None if it has not been measured on that core.

    `block`: the length of its blocks, None = all measured lengths together.
    """
    loads = {core: [row for row in _rows("loads") if _is(row, decoder, core)] for core in (core, _MEASURED_CORE)}
    sizes = [row for row in _rows("sizes") if (row["decoder"], row["kernels"]) == (decoder, _KERNELS)]
    decoding = [row for row in _rows("decoding") if row["decoder"] == decoder and block in (None, row["block"])]
    if not loads[core] or not sizes or not decoding:
        return None
    # Blocks of all lengths were measured on one core only. The ratio of the mean loads converts them to another.
    ratio = _mean_instructions(loads[core]) / _mean_instructions(loads[_MEASURED_CORE])
    one, two, four = (int(sizes[0][f"state_{channels}_bytes"]) for channels in (1, 2, 4))
    return DecoderCost(
        instructions=_fitted(decoding, ratio),
        flash_bytes=int(sizes[0]["code_bytes"]) + int(sizes[0]["image_bytes"]),
        state_bytes=(one, two, four),
        stack_bytes=max(int(row["stack_bytes"]) for row in loads[core]),
    )


def _is(row: dict[str, str], decoder: str, core: str) -> bool:
    return (row["decoder"], row["core"], row["kernels"]) == (decoder, core, _KERNELS)


def _mean_instructions(rows: list[dict[str, str]]) -> float:
    return float(np.mean([float(row["instructions"]) for row in rows]))


def _fitted(rows: list[dict[str, str]], ratio: float) -> tuple[float, float, float]:
    """Return the instructions of a quiet sample, another, and a bit: least squares of relative errors, none below 0."""
    from scipy.optimize import nnls

    measured, quiet, bits = (
        np.array([float(row[name]) for row in rows]) for name in ("instructions", "quiet", "bits_per_sample")
    )
    terms = np.stack([quiet, 1 - quiet, bits], axis=1) / measured[:, None]
    of_quiet, of_other, of_bit = ratio * nnls(terms, np.ones(len(rows)))[0]
    return float(of_quiet), float(of_other), float(of_bit)


@cache
def rest_memory(channels: int) -> tuple[int, int]:
    """Return bytes of flash and RAM of the firmware without its decoders; both are linear in the channels."""
    rows = list(_rows("controller"))
    measured = [int(row["channels"]) for row in rows]
    flash_bytes, ram_bytes = (
        round(_line(measured, [float(row[name]) for row in rows], channels)) for name in ("flash_bytes", "ram_bytes")
    )
    return flash_bytes, ram_bytes


def rest_instructions(
    board: str, core: str, unit: str, channels: int, rate_hz: float, packets_per_second: float
) -> float:
    """Return the firmware's instructions per second without decoding: messages, buffer, output stage.

    `board`: the controller's address; one that was not measured counts as the first of `board_cores` with its core.
    `unit`: PROFILE_UNIT for a profile over position, for which the later arguments do not matter.
    """
    if board not in board_cores():
        board = next(name for name, its_core in board_cores().items() if its_core == core)
    terms = _rest_terms(unit, channels, rate_hz, packets_per_second)
    return float(np.dot(_rest_fitted(board, unit == PROFILE_UNIT), terms))


@cache
def _rest_fitted(board: str, over_position: bool) -> NDArray[np.float64]:
    """Return the instructions of each of _rest_terms: least squares of relative errors, none below 0."""
    from scipy.optimize import nnls

    rows = [row for row in _rows("controller") if (row["board"], row["unit"] == PROFILE_UNIT) == (board, over_position)]
    measured = np.array([float(row["instructions"]) - float(row["decoding"]) for row in rows])
    terms = []
    for row in rows:
        rate_hz = float(row["rate_hz"])
        terms.append(_rest_terms(row["unit"], int(row["channels"]), rate_hz, rate_hz / float(row["packet_samples"])))
    weights: NDArray[np.float64] = nnls(np.array(terms) / measured[:, None], np.ones(len(rows)))[0]
    return weights


def _rest_terms(unit: str, channels: int, rate_hz: float, packets_per_second: float) -> tuple[float, ...]:
    """Return the terms of the rest: constant, channels, samples, integrated samples, and packets per second."""
    if unit == PROFILE_UNIT:
        return (1.0,)
    samples = rate_hz * channels
    return 1.0, channels, samples, samples if unit == "m/s^2" else 0.0, packets_per_second


def _line(x: tuple[int, ...] | list[int], y: tuple[int, ...] | list[float], at: float) -> float:
    return float(np.polyval(np.polyfit(x, y, 1), at))


def _rows(table: str) -> Iterator[dict[str, str]]:
    with (_TABLES / f"firmware_{table}.csv").open(newline="", encoding="utf-8") as file:
        yield from csv.DictReader(file)
