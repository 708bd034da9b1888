"""Counts what one codec alone takes on four processors: `python -m studies.small_parts --out docs/benchmarks`."""

import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click

from studies import page
from vibrocast import codec, extras
from vibrocast.device_protocol.coded_stream import StreamHeader, pack_file
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.evaluation import points
from vibrocast.firmware.build import CORTEX_M_FLAGS, FLAGS, M4F, M33, ROOT, BuildError, size
from vibrocast.firmware.elf import Elf

try:
    import unicorn
    from unicorn import arm_const, riscv_const

    from studies import worst_case
    from vibrocast.simulated_device.cycles import CycleCounter
except ModuleNotFoundError as error:
    raise SystemExit(str(extras.explained(error) or error)) from error

DECODERS = ("slp", "parametric", "dct", "mdct", "lapped-textures", "eva-16")
"""Codecs, and the smallest family of models of those that need one."""
_CODECS = ("mdct", "dct", "slp", "eva", "lapped", "parametric")
CONTROLLERS = ("small-slp", "small-mdct")
TABLE = "small_parts.csv"
_FLASH, _RAM, _DATA = 0x0800_0000, 0x2000_0000, 0x6000_0000
_MEMORY_BYTES = 1 << 20
_STACK_BYTES = 1 << 15
_TOP = _RAM + _MEMORY_BYTES
_RETURN = _DATA + _MEMORY_BYTES - 4
_STREAM, _ARRAY, _PACKET, _MODEL, _FILE, _SAMPLES = (
    _DATA + offset for offset in (0, 0x100, 0x1000, 0x20000, 0x80000, 0xC0000)
)
_PACKET_SAMPLES_AT, _NEEDED_AT = 88, 96  # of a vc_stream, where a pointer has 4 bytes
_FUNCTIONS = ("vc_stream_open", "vc_stream_next", "vc_stream_poll", "vc_array_read")
_PAINT = b"\xa5"
_ARM = tuple(getattr(arm_const, f"UC_ARM_REG_R{number}") for number in range(4))
_RISCV = tuple(getattr(riscv_const, f"UC_RISCV_REG_A{number}") for number in range(4))


@dataclass(frozen=True)
class Processor:
    """A processor: its name, clock, flags of the compiler, and model of the emulator, of Arm or of RISC-V.

    `counts_cycles`: the cycle counter has a model of it; of the others, instructions are counted.
    """

    title: str
    clock_hz: float
    flags: tuple[str, ...]
    model: int
    arm: bool = True
    counts_cycles: bool = False


def _cortex_m(processor: str, abi: str = "eabihf") -> tuple[str, ...]:
    flags = tuple(flag.replace("eabihf", abi) for flag in CORTEX_M_FLAGS)
    return (*flags, f"-mcpu={processor}")


PROCESSORS = (
    Processor("Cortex-M0+", 133e6, _cortex_m("cortex_m0plus", "eabi"), arm_const.UC_CPU_ARM_CORTEX_M0),
    Processor("Cortex-M4F", 168e6, _cortex_m(M4F), arm_const.UC_CPU_ARM_CORTEX_M4, counts_cycles=True),
    Processor("Cortex-M33", 150e6, _cortex_m(M33), arm_const.UC_CPU_ARM_CORTEX_M33),
    Processor(
        "RV32IMC",
        160e6,
        ("-target", "riscv32-freestanding", "-mcpu=generic_rv32+m+c", "-ffreestanding", "-fno-builtin", "-g0"),
        riscv_const.UC_CPU_RISCV32_SIFIVE_E31,
        arm=False,
    ),
)
"""With the clocks of an RP2040, an STM32F405, an RP2350 and an ESP32-C3."""


@dataclass(frozen=True)
class Cost:
    """Memory and time of a decoder of one channel, with the reader of .vct files.

    Sizes in bytes: `flash` without a model image, `ram` of its state, the most `stack` that a call used.
    `per_sample`: cycles where the processor has a model, or else instructions, of the most expensive stream; None:
    not measured.
    """

    processor: str
    decoder: str
    flash: int
    ram: int
    stack: int
    per_sample: float | None
    load_percent: float | None


def compile_decoder(output: Path, processor: Processor, codec_name: str) -> Path:
    """Link the decoder of one codec with the reader of files, -Os; return the program. Raises BuildError."""
    script = output.with_suffix(".ld")
    script.write_text(f"SECTIONS {{ . = {_FLASH}; .text : {{ *(.text*) *(.rodata*) *(.srodata*) }} }}\n")
    only = [f"-DVC_WITH_{name.upper()}={int(name == codec_name)}" for name in _CODECS]
    sources = [path for path in sorted((ROOT / "src" / "core").glob("*.c")) if not path.stem.endswith("_encoder")]
    options = [*FLAGS, *processor.flags, "-Os", "-g1", "-DVC_MAX_CHANNELS=1", *only, f"-I{ROOT / 'include'}"]
    link = ["-Wl,--gc-sections", "-Wl,--entry=0", "-T", str(script), *(f"-Wl,-u,{name}" for name in _FUNCTIONS)]
    paths = [str(path) for path in (*sources, Path(__file__).with_name("array_reader.c"))]
    command = [sys.executable, "-m", "ziglang", "cc", *options, *link, *paths, "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise BuildError(f"the decoder cannot be compiled for {processor.title}:\n{done.stderr}")
    return output


class Machine:
    """An emulated processor with a program, and the stack that its calls used; `spent`: cycles or instructions."""

    def __init__(self, program: Path, processor: Processor) -> None:
        """Load a program of compile_decoder."""
        image = Elf(program)
        self.flash_bytes = sum(segment.size_bytes for segment in image.segments)
        self.symbols = image.symbols
        self.stack_bytes = 0
        self._processor = processor
        if processor.arm:
            mode = unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS
            self.emulator: Any = unicorn.Uc(unicorn.UC_ARCH_ARM, mode)
            self._arguments, self._stack, self._link = _ARM, arm_const.UC_ARM_REG_SP, arm_const.UC_ARM_REG_LR
        else:
            self.emulator = unicorn.Uc(unicorn.UC_ARCH_RISCV, unicorn.UC_MODE_RISCV32)
            self._arguments, self._stack, self._link = (
                _RISCV,
                riscv_const.UC_RISCV_REG_SP,
                riscv_const.UC_RISCV_REG_RA,
            )
        self.emulator.ctl_set_cpu_model(processor.model)
        for start in (_FLASH, _RAM, _DATA):
            self.emulator.mem_map(start, _MEMORY_BYTES)
        for segment in image.segments:
            self.emulator.mem_write(segment.address, segment.data)
        self._counter = CycleCounter(self.emulator) if processor.arm else None
        self._instructions = 0
        self._lengths: dict[tuple[int, int], int] = {}
        if not processor.arm:
            self.emulator.hook_add(unicorn.UC_HOOK_BLOCK, self._count_block)

    def _count_block(self, emulator: Any, address: int, size_bytes: int, _: Any) -> None:
        """Count the instructions of a RISC-V block: those of 4 bytes end their first two bits with 11."""
        key = address, size_bytes
        if key not in self._lengths:
            code, at, count = bytes(emulator.mem_read(address, size_bytes)), 0, 0
            while at < size_bytes:
                at += 4 if code[at] & 3 == 3 else 2
                count += 1
            self._lengths[key] = count
        self._instructions += self._lengths[key]

    @property
    def spent(self) -> int:
        """Cycles so far where the counter has a model of the processor, or else instructions."""
        if self._counter is None:
            return self._instructions
        return self._counter.cycles if self._processor.counts_cycles else self._counter.instructions

    def call(self, function: str, *arguments: int) -> int:
        """Call a function with integers and addresses; return what it returns."""
        self.emulator.mem_write(_TOP - _STACK_BYTES, _PAINT * _STACK_BYTES)
        for register, value in zip(self._arguments, arguments, strict=False):
            self.emulator.reg_write(register, value)
        thumb = int(self._processor.arm)
        self.emulator.reg_write(self._stack, _TOP)
        self.emulator.reg_write(self._link, _RETURN | thumb)
        self.emulator.emu_start(self.symbols[function] | thumb, _RETURN)
        used = bytes(self.emulator.mem_read(_TOP - _STACK_BYTES, _STACK_BYTES)).lstrip(_PAINT)
        self.stack_bytes = max(self.stack_bytes, len(used))
        return int(self.emulator.reg_read(self._arguments[0])) & 0xFFFF_FFFF

    def word(self, address: int) -> int:
        """Return a number of four bytes in memory."""
        return int(struct.unpack("<I", bytes(self.emulator.mem_read(address, 4)))[0])


def file_of(hostile: worst_case.Hostile, image: bytes | None) -> bytes:
    """Return the .vct file of a stream from worst_case; `image`: its model image."""
    stream = hostile.stream
    name = codec.CODECS[stream.codec].identifier
    hashed = b"" if image is None else sha256(image)[:4]
    header = StreamHeader(name, stream.rate_hz, None, "full scale", (1.0,), stream.configuration, hashed)
    return pack_file(header, hostile.packets)


def run(machine: Machine, file: bytes, image: bytes | None) -> tuple[int, float]:
    """Decode a file; return the bytes of the decoder's state, and what a sample takes. Raises BuildError."""
    machine.emulator.mem_write(_FILE, file)
    machine.emulator.mem_write(_MODEL, image or b"")
    machine.emulator.mem_write(_ARRAY, struct.pack("<II", _FILE, len(file)))
    given = (machine.symbols["vc_array_read"], _ARRAY, _RAM, 1 << 19, _PACKET, 65535)
    model = (_MODEL, len(image)) if image else (0, 0)
    machine.emulator.mem_write(_STREAM, struct.pack("<8I", *given, *model).ljust(128, b"\0"))
    if machine.call("vc_stream_open", _STREAM) != 0:
        raise BuildError("the emulated decoder does not open the stream")
    packet_samples, samples, before = machine.word(_STREAM + _PACKET_SAMPLES_AT), 0, machine.spent
    while (status := machine.call("vc_stream_next", _STREAM)) == 0:
        while machine.call("vc_stream_poll", _STREAM, _SAMPLES) < packet_samples:
            pass
        samples += packet_samples
    if status != 2 or samples == 0:
        raise BuildError(f"the emulated decoder ends with status {status}")
    return machine.word(_STREAM + _NEEDED_AT), (machine.spent - before) / samples


def hostile_stream(folder: Path, decoder: str) -> tuple[bytes, bytes | None]:
    """Return the file of the most expensive stream that worst_case begins with, and its model image."""
    results = Path(__file__).parents[1] / "docs" / "benchmarks" / "results"
    rows = points.read_rows(results / worst_case.COSTS, worst_case.Cost)
    costs = [row for row in rows if (row.decoder, row.channels) == (decoder, 1)]
    block = max(costs, key=lambda cost: cost.hostile_cycles).block
    _, hostile = worst_case.costliest(worst_case.emulated(folder), decoder, block, 1, 0)
    _, model = worst_case.codec_of(decoder)
    image = None
    if model is not None and hostile.tables is not None:
        image = replace(ModelImage.unpack(model.image), payload=hostile.tables, number=0, signature=b"").pack()
    return file_of(hostile, image), image


def measure(folder: Path) -> Iterator[Cost]:
    """Yield the cost of each decoder on each processor. Raises BuildError and MissingExtraError."""
    extras.require("firmware", "ziglang")
    for decoder in DECODERS:
        file, image = hostile_stream(folder, decoder)
        for processor in PROCESSORS:
            program = compile_decoder(folder / f"{decoder}-{processor.title}.elf", processor, file_codec(decoder))
            machine = Machine(program, processor)
            ram, per_sample = run(machine, file, image)
            load = 100 * per_sample * worst_case.RATE_HZ / processor.clock_hz
            yield Cost(processor.title, decoder, machine.flash_bytes, ram, machine.stack_bytes, per_sample, load)


def file_codec(decoder: str) -> str:
    """Return the codec of a decoder: its own name, or that of its models' family."""
    return worst_case.codec_of(decoder)[0]


def write_page(out: Path, costs: list[Cost]) -> None:
    """Write the page and its table. Raises OSError."""
    page.write_rows(page.results_folder(out) / TABLE, costs, Cost)
    controllers = {name: size(name) for name in CONTROLLERS}
    text = page.render("small_parts", costs=costs, processors=PROCESSORS, decoders=DECODERS, controllers=controllers)
    page.write(out / "small_parts.md", text)


@click.command()
@page.OUT
def main(out: Path) -> None:
    """Print flash, RAM, stack and worst-case load of each codec, and write them as a page."""
    costs = []
    click.echo(f"{'processor':<12}{'decoder':<17}{'flash':>8}{'RAM':>8}{'stack':>7}{'a sample':>10}{'load':>9}")
    with page.errors_in_one_line(), tempfile.TemporaryDirectory() as folder:
        for cost in measure(Path(folder)):
            costs.append(cost)
            spent = f"{cost.per_sample:>10.0f}{cost.load_percent:>7.1f} %"
            click.echo(f"{cost.processor:<12}{cost.decoder:<17}{cost.flash:>8}{cost.ram:>8}{cost.stack:>7}{spent}")
        write_page(out, costs)


if __name__ == "__main__":
    main()
