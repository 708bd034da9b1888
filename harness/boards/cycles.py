"""Counts what code takes on an emulated processor: instructions exactly, cycles by a model of the Cortex-M4."""

import ctypes
from itertools import pairwise
from typing import Any

import capstone
import unicorn
from capstone import arm_const as arm
from unicorn.unicorn_py3 import unicorn as binding

from vibrocast.firmware.build import build

NEVER = (1 << 64) - 1
"""A deadline that does not come."""

_REFILL_CYCLES = 2
_DIVISION_CYCLES = 12
_LOADS = {arm.ARM_INS_LDR, arm.ARM_INS_LDRB, arm.ARM_INS_LDRH, arm.ARM_INS_LDRSB, arm.ARM_INS_LDRSH}
_SINGLE = _LOADS | {arm.ARM_INS_STR, arm.ARM_INS_STRB, arm.ARM_INS_STRH}
_PAIRS = {arm.ARM_INS_LDRD, arm.ARM_INS_STRD}
_STACKED = {arm.ARM_INS_PUSH, arm.ARM_INS_POP}
_MULTIPLE = {arm.ARM_INS_LDM, arm.ARM_INS_LDMDB, arm.ARM_INS_STM, arm.ARM_INS_STMDB}
_DIVISIONS = {arm.ARM_INS_UDIV, arm.ARM_INS_SDIV}
_TABLE_BRANCHES = {arm.ARM_INS_TBB, arm.ARM_INS_TBH}

_MEASURE = ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_uint32)


class _Head(ctypes.Structure):
    """The first members of struct vc_cycle_counter of firmware/emulator/cycle_counter.c."""

    _fields_ = (
        ("instructions", ctypes.c_uint64),
        ("cycles", ctypes.c_uint64),
        ("deadline", ctypes.c_uint64),
        ("jump_cycles", ctypes.c_uint32),
        ("end", ctypes.c_uint32),
        ("stop", ctypes.c_void_p),
        ("measure", _MEASURE),
        ("address", ctypes.c_uint32),
        ("block_instructions", ctypes.c_uint16),
        ("block_cycles", ctypes.c_uint16),
    )


class CycleCounter:
    """Counts the code that an emulator runs, and stops it at a deadline.

    `emulator`: a unicorn.Uc for Thumb code. Raises BuildError, because a small library is compiled at the first use.
    """

    def __init__(self, emulator: Any) -> None:
        library = ctypes.CDLL(str(build("cycle-counter")))
        library.vc_cycle_counter_size.restype = ctypes.c_size_t
        self._emulator = emulator
        self._memory = ctypes.create_string_buffer(library.vc_cycle_counter_size())
        self._head = _Head.from_buffer(self._memory)
        self._head.deadline = NEVER
        self._head.jump_cycles = _REFILL_CYCLES
        self._head.stop = ctypes.cast(binding.uclib.uc_emu_stop, ctypes.c_void_p).value
        self._head.measure = self._measure = _MEASURE(self._measure_block)
        self._disassembler = capstone.Cs(capstone.CS_ARCH_ARM, capstone.CS_MODE_THUMB | capstone.CS_MODE_MCLASS)
        self._disassembler.detail = True
        self._handle = ctypes.c_size_t()
        # The public interface of the package takes Python functions only.
        status = binding.uclib.uc_hook_add(
            emulator._uch,
            ctypes.byref(self._handle),
            unicorn.UC_HOOK_BLOCK,
            library.vc_count_block,
            ctypes.cast(self._memory, ctypes.c_void_p),
            ctypes.c_uint64(1),
            ctypes.c_uint64(0),
        )
        if status != unicorn.UC_ERR_OK:
            raise unicorn.UcError(status)
        self._library = library  # keeps the hook's code

    @property
    def instructions(self) -> int:
        """Instructions so far."""
        return int(self._head.instructions)

    @property
    def cycles(self) -> int:
        """Cycles that a Cortex-M4 would have needed so far, by the model of docs/benchmarks/firmware.md."""
        return int(self._head.cycles)

    def add_cycles(self, cycles: int) -> None:
        """Count cycles that no code takes, such as the entry of an interrupt."""
        self._head.cycles += cycles

    def stop_at(self, cycles: int | None) -> None:
        """Stop the emulator behind the block that reaches `cycles`; None = never."""
        self._head.deadline = NEVER if cycles is None else cycles

    def _measure_block(self, address: int, size_bytes: int) -> None:
        block = list(self._disassembler.disasm(bytes(self._emulator.mem_read(address, size_bytes)), address))
        self._head.block_instructions = len(block)
        self._head.block_cycles = block_cycles(block)


def block_cycles(block: list[Any]) -> int:
    """Return the cycles of a Cortex-M4 for capstone's instructions of a block, without a jump to it."""
    return sum(_cycles(before, instruction) for before, instruction in pairwise([None, *block]))


def _cycles(before: Any, instruction: Any) -> int:
    """Return the cycles of an instruction behind another on a Cortex-M4, the refill of taken branches not included.

    ARM DDI 0439 (Cortex-M4 Technical Reference Manual), 3.3.1 and 3.3.3.
    """
    kind = instruction.id
    if kind in _SINGLE:
        memory = next(operand.mem for operand in instruction.operands if operand.type == capstone.CS_OP_MEM)
        address = {memory.base, memory.index} - {0}
        written = set(before.regs_access()[1]) if before is not None else set()
        pipelined = before is not None and before.id in _LOADS and before.operands[0].reg not in address
        stalled = before is not None and before.id not in _SINGLE and bool(written & address)
        alone = 2 if kind in _LOADS or memory.index else 1
        return max(1, alone - pipelined) + stalled
    registers: int = sum(operand.type == capstone.CS_OP_REG for operand in instruction.operands)
    if kind in _PAIRS:
        return 3
    if kind in _STACKED:
        return 1 + registers
    if kind in _MULTIPLE:
        return registers  # one of them is the base
    if kind in _DIVISIONS:
        return _DIVISION_CYCLES
    return 2 if kind in _TABLE_BRANCHES else 1
