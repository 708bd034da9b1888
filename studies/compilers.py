"""Compares two compilers on five processors: `python -m studies.compilers --out docs/benchmarks`."""

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import vibrocast
from studies import page
from studies.emulated_core import CORES, CORTEX_M3, RISC_V, ZIG, Core, EmulatedCore
from studies.small_parts import COUNTED, compile_decoder, run
from vibrocast import textures
from vibrocast.device_protocol.coded_stream import pack_file
from vibrocast.errors import InputError

DECODERS = ("slp", "mdct")
RATE_HZ = 2800
SNR_DB = 10.0
TABLE = "compilers.csv"
_RV32 = ("riscv64-unknown-elf-gcc", "-march=rv32imc", "-mabi=ilp32")
_ARM = ("arm-none-eabi-gcc", "-mthumb")
GCC: dict[Core, tuple[str, ...]] = {
    CORES["M0+"]: (*_ARM, "-mcpu=cortex-m0plus"),
    CORTEX_M3: (*_ARM, "-mcpu=cortex-m3"),
    CORES["M4F"]: (*_ARM, "-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
    CORES["M33"]: (*_ARM, "-mcpu=cortex-m33", "-mfpu=fpv5-sp-d16", "-mfloat-abi=hard"),
    RISC_V: _RV32,
}
"""GCC's command for each processor."""


@dataclass(frozen=True)
class Row:
    """A decoder by one compiler. Sizes in bytes; `per_sample`: instructions, or cycles where they have a model."""

    processor: str
    decoder: str
    compiler: str
    flash: int
    ram: int
    stack: int
    per_sample: float
    load_percent: float


def compilers(core: Core) -> Iterator[tuple[str, tuple[str, ...], Core]]:
    """Yield the name, the command and the processor's flags of zig and of GCC."""
    yield "zig", ZIG, core
    program, *flags = GCC[core]
    if shutil.which(program) is None:
        raise InputError(f"{program} is not installed; install gcc-arm-none-eabi and gcc-riscv64-unknown-elf")
    yield "GCC", (program,), replace(core, flags=(*flags, "-ffreestanding", "-nostartfiles", "-nolibc"))


def version(command: tuple[str, ...]) -> str:
    """Return the first line with which a compiler names itself."""
    return subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout.partition("\n")[0]


def measure(folder: Path) -> Iterator[Row]:
    """Yield each decoder on each processor by each compiler. Raises BuildError and MissingExtraError."""
    texture = textures.resample(textures.GENERATORS["rough"](3, 1.0), RATE_HZ)
    for decoder in DECODERS:
        stream = vibrocast.encode(texture, codec=decoder, snr_db=SNR_DB)
        file = pack_file(stream.header, stream.packets)
        for core in GCC:
            for compiler, command, flags in compilers(core):
                program = compile_decoder(folder / f"{decoder}-{core.title}-{compiler}.elf", flags, decoder, command)
                emulated = EmulatedCore(program, core)
                ram, per_sample = run(emulated, core, file, None)
                load = 100 * per_sample * RATE_HZ / core.clock_hz
                sizes = emulated.flash_bytes, ram, emulated.stack_bytes
                yield Row(core.title, decoder, compiler, *sizes, per_sample, load)


@page.study
def main(out: Path) -> None:
    """Count flash, stack and load by zig and by GCC, and write their part of firmware.md."""
    with tempfile.TemporaryDirectory() as folder:
        rows = list(measure(Path(folder)))
    versions = {name: version(command) for core in (CORES["M0+"], RISC_V) for name, command, _ in compilers(core)}
    text = page.render("compilers", globals(), rows=rows, versions=versions, counted=COUNTED.title)
    page.publish(out, "firmware", text, [(TABLE, rows, Row)])


if __name__ == "__main__":
    main()
