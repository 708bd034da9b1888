"""The core's decoders as a processor runs them: compiled for it, called in an emulator, their instructions counted."""

import struct
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vibrocast import codec, extras, models
from vibrocast.codec import Decoded, Stream
from vibrocast.evaluation import trained
from vibrocast.firmware.build import FLAGS, M0_PLUS, M3, M4F, M7, M33, ROOT, cortex_m_flags
from vibrocast.firmware.elf import Elf
from vibrocast.firmware.native_core import BuildError
from vibrocast.models import Model

try:
    import unicorn
    from unicorn import arm_const, riscv_const

    from vibrocast.harness.boards.cycles import CycleCounter
except ModuleNotFoundError as error:
    raise SystemExit(str(extras.explained(error) or error)) from error

ZIG = (sys.executable, "-m", "ziglang", "cc")
DECODERS = ("mdct", "dct", "slp", "eva-16", "eva-128", "parametric")
"""Codecs, and families of models that ship."""
DECODE, DECODE_IN_BLOCKS = (
    ("decoder_size", "decoder_init", "decoder_packet_samples", *functions)
    for functions in (("decode",), ("feed", "poll"))
)
"""The functions of a codec that `decode` and `decode_in_blocks` call; `vc_NAME_` stands before each."""

_FLASH, _RAM, _DATA = 0x0800_0000, 0x2000_0000, 0x6000_0000
_MEMORY_BYTES = 1 << 20
_STACK_BYTES = 1 << 15
_TOP = _RAM + _MEMORY_BYTES
_RETURN = _DATA + _MEMORY_BYTES - 4
_PAINT = b"\xa5"
_CONFIGURATION, _TABLES, _PACKET, _SAMPLES = (_DATA + offset for offset in (0, 0x100, 0x80000, 0x90000))
_ARM = [getattr(arm_const, f"UC_ARM_REG_{name}") for name in ("SP", "LR", "R0", "R1", "R2", "R3")]
_RISC_V = [getattr(riscv_const, f"UC_RISCV_REG_{name}") for name in ("SP", "RA", "A0", "A1", "A2", "A3")]
"""Stack pointer, return address, and the first four arguments."""


@dataclass(frozen=True)
class Core:
    """A processor: its title, the clock that its load is given for, the compiler's flags, and the emulator's model.

    `arm`: a Cortex-M; if not, RISC-V.
    """

    title: str
    clock_hz: float
    flags: tuple[str, ...]
    emulated_as: int
    arm: bool = True


CORES = {
    "M4F": Core("Cortex-M4F", 168e6, cortex_m_flags(M4F), arm_const.UC_CPU_ARM_CORTEX_M4),
    "M7": Core("Cortex-M7", 480e6, cortex_m_flags(M7), arm_const.UC_CPU_ARM_CORTEX_M7),
    "M33": Core("Cortex-M33", 150e6, cortex_m_flags(M33), arm_const.UC_CPU_ARM_CORTEX_M33),
    "M0+": Core("Cortex-M0+", 133e6, cortex_m_flags(M0_PLUS), arm_const.UC_CPU_ARM_CORTEX_M0),
}
"""With the clocks of an STM32F405, an STM32H743, an RP2350 and an RP2040."""
CORTEX_M3 = Core("Cortex-M3", 72e6, cortex_m_flags(M3), arm_const.UC_CPU_ARM_CORTEX_M3)
"""With the clock of an STM32F103."""

RISC_V = Core(
    "RV32IMC",
    160e6,
    (
        *("-target", "riscv32-freestanding", "-mcpu=generic_rv32+m+c", "-ffreestanding", "-fno-builtin"),
        *("-fno-unwind-tables", "-g0"),
    ),
    riscv_const.UC_CPU_RISCV32_SIFIVE_E31,
    arm=False,
)
"""With the clock of an ESP32-C3."""


def members_of(decoder: str) -> list[Model]:
    """Return the models of a family, from the coarsest to the finest; none of a codec's own name."""
    return [] if decoder in codec.CODECS else models.members(decoder)


def codec_of(decoder: str) -> str:
    """Return the codec of a decoder: its own name, or that of its family's models."""
    return decoder if decoder in codec.CODECS else trained.codec_name(members_of(decoder)[0])


def functions_of(names: Iterable[str], functions: Sequence[str]) -> list[str]:
    """Return the names in the core of `functions` of some codecs."""
    return [f"vc_{name}_{function}" for name in sorted(names) for function in functions]


def compile_core(
    output: Path,
    core: Core,
    functions: Sequence[str],
    defines: Mapping[str, int] | None = None,
    options: Sequence[str] = (),
    further: Sequence[Path] = (),
    compiler: Sequence[str] = ZIG,
) -> Path:
    """Link functions of the core's decoders, all that they need and nothing else; return the program, `output`.

    `defines`: macros and their values. `options`: further ones of the compiler. `further`: sources besides the core's.
    `compiler`: zig, or another one that takes the flags of `core`. Raises BuildError and MissingExtraError.
    """
    extras.require("firmware", "ziglang")
    script = output.with_suffix(".ld")
    script.write_text(
        f"SECTIONS {{ . = {_FLASH}; .text : {{ *(.text*) *(.rodata*) *(.srodata*) }} }}\n", encoding="utf-8"
    )
    roots = [f"-Wl,-u,{name}" for name in functions]
    defined = [f"-D{name}={value}" for name, value in (defines or {}).items()]
    sources = [str(path) for path in sorted((ROOT / "src" / "core").glob("*.c")) if not path.stem.endswith("_encoder")]
    sources += map(str, further)
    given = [*FLAGS, *core.flags, f"-I{ROOT / 'include'}", *options, "-Wl,--entry=0", "-T", str(script)]
    command = [*compiler, *given, *roots, *defined, *sources, "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise BuildError(f"the core cannot be compiled for {core.title}:\n{done.stderr}")
    return output


class EmulatedCore:
    """Functions of the core on an emulated processor; `stack_bytes` is the most that a call has used."""

    def __init__(self, program: Path, core: Core) -> None:
        """Load a program of compile_core."""
        image = Elf(program)
        self.flash_bytes = sum(len(segment.data) for segment in image.segments)
        self.symbols = image.symbols
        self._thumb = int(core.arm)
        self._registers = _ARM if core.arm else _RISC_V
        arm = unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS
        risc_v = unicorn.UC_ARCH_RISCV, unicorn.UC_MODE_RISCV32
        self._machine: Any = unicorn.Uc(*(arm if core.arm else risc_v))
        self._machine.ctl_set_cpu_model(core.emulated_as)
        for start in (_FLASH, _RAM, _DATA):
            self._machine.mem_map(start, _MEMORY_BYTES)
        for segment in image.segments:
            self.write(segment.address, segment.data)
        self._counter: Any = CycleCounter(self._machine) if core.arm else _RiscVCounter(self._machine)
        self.clear()

    def clear(self) -> None:
        """Start the count again."""
        self.stack_bytes = 0
        self._before: tuple[int, int] = (self._counter.instructions, self._counter.cycles)

    def write(self, address: int, data: bytes) -> None:
        """Put bytes into memory."""
        self._machine.mem_write(address, data)

    def read(self, address: int, size_bytes: int) -> bytes:
        """Return bytes of memory."""
        return bytes(self._machine.mem_read(address, size_bytes))

    def word(self, address: int) -> int:
        """Return a number of four bytes in memory."""
        return int(struct.unpack("<I", self.read(address, 4))[0])

    def call(self, function: str, *arguments: int) -> int:
        """Call a function with integers and addresses, on RISC-V at most four of them; return what it returns."""
        stacked = struct.pack(f"<{max(0, len(arguments) - 4)}I", *arguments[4:])
        stack = _TOP - (len(stacked) + 7) // 8 * 8
        self.write(_TOP - _STACK_BYTES, _PAINT * _STACK_BYTES)
        self.write(stack, stacked)
        given = (stack, _RETURN | self._thumb, *arguments)
        for register, value in zip(self._registers, given, strict=False):
            self._machine.reg_write(register, value)
        self._machine.emu_start(self.symbols[function] | self._thumb, _RETURN)
        used = self.read(_TOP - _STACK_BYTES, _STACK_BYTES).lstrip(_PAINT)
        self.stack_bytes = max(self.stack_bytes, len(used))
        return int(np.int32(np.uint32(self._machine.reg_read(self._registers[2]) & 0xFFFF_FFFF)))

    @property
    def instructions(self) -> int:
        """Instructions carried out since the last `clear`."""
        return int(self._counter.instructions) - self._before[0]

    @property
    def cycles(self) -> int:
        """Cycles that a Cortex-M4 would have needed since the last `clear`, by docs/benchmarks/firmware.md's model."""
        return int(self._counter.cycles) - self._before[1]


class _RiscVCounter:
    """Counts the instructions of an emulated RISC-V processor. Its cycles have no model."""

    cycles = 0

    def __init__(self, machine: Any) -> None:
        self.instructions = 0
        self._lengths: dict[tuple[int, int], int] = {}
        machine.hook_add(unicorn.UC_HOOK_BLOCK, self._count_block)

    def _count_block(self, machine: Any, address: int, size_bytes: int, _: Any) -> None:
        """Count the instructions of a block: those of 4 bytes end their first two bits with 11."""
        key = address, size_bytes
        if key not in self._lengths:
            code, at, count = bytes(machine.mem_read(address, size_bytes)), 0, 0
            while at < size_bytes:
                at += 4 if code[at] & 3 == 3 else 2
                count += 1
            self._lengths[key] = count
        self.instructions += self._lengths[key]


@dataclass(frozen=True)
class Run:
    """The cost of decoding a stream: instructions, and cycles of a Cortex-M4, per sample; most bytes of stack."""

    decoded: Decoded
    instructions: float
    cycles: float
    stack_bytes: int


def decode(program: Path, core: Core, coded: Stream) -> Run:
    """Decode a stream on an emulated processor. Raises ValueError where the decoder does not take it."""
    emulated_core = EmulatedCore(program, core)
    name = coded.codec_name
    packet_samples = _start(emulated_core, coded, coded.tables)
    samples = packet_samples * len(coded.packets)
    emulated_core.clear()
    decoded = b""
    for packet in coded.packets:
        emulated_core.write(_PACKET, packet)
        if emulated_core.call(f"vc_{name}_decode", _RAM, _PACKET, len(packet), _SAMPLES) != 0:
            raise ValueError(f"{name}: the decoder does not take a packet")
        decoded += emulated_core.read(_SAMPLES, 2 * packet_samples * coded.header.channels)
    return Run(
        np.frombuffer(decoded, "<i2").astype(np.int16).reshape(samples, coded.header.channels),
        emulated_core.instructions / samples,
        emulated_core.cycles / samples,
        emulated_core.stack_bytes,
    )


@dataclass(frozen=True)
class Costs:
    """Cycles of decoding block by block: the most to take a packet, the most of a block, and all for each sample."""

    feed_cycles: int
    block_cycles: int
    sample_cycles: float

    def most(self, other: "Costs") -> "Costs":
        """Return the greater of each."""
        return Costs(*map(max, zip(astuple(self), astuple(other), strict=True)))


def decode_in_blocks(
    emulated_core: EmulatedCore, coded: Stream, tables: bytes | None, packets: Sequence[bytes]
) -> Costs:
    """Decode packets, damaged ones as well, as those of a stream, and a block a call as controllers do.

    Raises ValueError where the decoder does not take the stream.
    """
    name = coded.codec_name
    packet_samples = _start(emulated_core, coded, tables)
    feed = block = whole = 0
    for packet in packets:
        emulated_core.write(_PACKET, packet)
        emulated_core.clear()
        status = emulated_core.call(f"vc_{name}_feed", _RAM, _PACKET, len(packet))
        feed, whole = max(feed, emulated_core.cycles), whole + emulated_core.cycles
        done = 0 if status >= 0 else packet_samples
        while done < packet_samples:
            emulated_core.clear()
            done = emulated_core.call(f"vc_{name}_poll", _RAM, _SAMPLES)
            block, whole = max(block, emulated_core.cycles), whole + emulated_core.cycles
    return Costs(feed, block, whole / (packet_samples * len(packets)))


def _start(emulated_core: EmulatedCore, coded: Stream, tables: bytes | None) -> int:
    """Start a decoder of a stream; return the samples of its packets. Raises ValueError."""
    name = coded.codec_name
    arguments = [_RAM, _CONFIGURATION, len(coded.header.configuration), coded.header.channels]
    if codec.CODECS[name].tables is not None:
        arguments += [_TABLES, len(tables)] if tables else [0, 0]
    emulated_core.write(_CONFIGURATION, coded.header.configuration)
    emulated_core.write(_TABLES, tables or b"")
    if emulated_core.call(f"vc_{name}_decoder_init", *arguments) != 0:
        raise ValueError(f"{name}: the decoder does not take the configuration or the model")
    return emulated_core.call(f"vc_{name}_decoder_packet_samples", _RAM)


def state_bytes(emulated_core: EmulatedCore, name: str) -> int:
    """Return the bytes of a decoder's state."""
    return emulated_core.call(f"vc_{name}_decoder_size")
