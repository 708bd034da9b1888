"""Compares two compilers on five processors: `python -m studies.compilers --out docs/benchmarks`."""

import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import vibrocast
from studies import page
from studies.emulated_core import CORES, CORTEX_M3, RISC_V, ZIG, Core, EmulatedCore
from studies.small_parts import COUNTED, compile_decoder, compile_small, run
from vibrocast import textures
from vibrocast.codec import Stream
from vibrocast.codec.encoding import encode_recording
from vibrocast.device_protocol.coded_stream import pack_file
from vibrocast.device_protocol.messages import State
from vibrocast.errors import InputError
from vibrocast.firmware.build import ROOT, SMALL_BOARD, only
from vibrocast.firmware.elf import Elf
from vibrocast.firmware.native_core import BuildError
from vibrocast.host import player
from vibrocast.host.controller import Controller
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.simulated_device.memory_link import MemoryLink

CODECS = ("slp", "mdct")
DECODER, CONTROLLER = "decoder", "controller"
PROGRAMS = ((DECODER, "-Os"), (CONTROLLER, "-Os"), (CONTROLLER, "-O2"))
"""What is compiled, and for what."""
RATE_HZ = 2800
SECONDS = 1.0
SNR_DB = 10.0
DAC_RATE_HZ = PIEZO_STACK.dac_rate_hz
"""Of the actuator in memory_port.c."""
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
    """A program of one codec by one compiler.

    `level`: the compiler's option. Sizes in bytes; `ram`: of the state, without stack. `per_sample`: instructions, or
    cycles where they have a model.
    """

    processor: str
    program: str
    codec: str
    level: str
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


def compile_controller(output: Path, core: Core, codec_name: str, compiler: Sequence[str], level: str) -> Path:
    """Link a controller of one codec, its loop, and a port in memory; return the program. Raises as compile_core."""
    sources = [Path(__file__).with_name("memory_port.c"), ROOT / "ports" / "loop.c"]
    sources += sorted((ROOT / "src" / "controller").glob("*.c"))
    switches = {**SMALL_BOARD, **only(codec_name.upper())}
    return compile_small(output, core, ("vc_memory_port_start", "vc_loop_turn"), switches, sources, compiler, level)


class EmulatedController:
    """A controller (simulated_device.device.Device) of compile_controller, whose turns take no simulated time."""

    _LINE_BYTES = 4096
    _INCOMING_AT = 24  # in vc_memory_port

    def __init__(self, core: EmulatedCore) -> None:
        self._core, self._port = core, core.symbols["vc_memory_port"]
        core.call("vc_memory_port_start")

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self._core.write(self._port, struct.pack("<QII", now_us, len(data), 0))
        self._core.write(self._port + self._INCOMING_AT, data)
        while self._core.call("vc_loop_turn"):
            pass

    def advance(self, now_us: int) -> None:
        """Play the samples that are due."""
        self.receive(b"", now_us)

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
        length = self._core.word(self._port + 16)
        self._core.write(self._port + 16, bytes(4))
        return self._core.read(self._port + self._INCOMING_AT + self._LINE_BYTES, length)


def play(emulated: EmulatedCore, core: Core, stream: Stream) -> float:
    """Play a stream on an emulated controller; return what a sample takes. Raises BuildError and ControllerError."""
    link = MemoryLink(EmulatedController(emulated))
    host = Controller(link, link.clock, link.sleep)
    emulated.clear()
    result = player.play(host, stream)
    if result.state != State.FINISHED or result.underruns or result.lost_packets:
        raise BuildError(f"the emulated controller ends in the state {result.state.name}")
    return (emulated.cycles if core == COUNTED else emulated.instructions) / (SECONDS * RATE_HZ)


def measure(folder: Path) -> Iterator[Row]:
    """Yield each program on each processor by each compiler. Raises BuildError and MissingExtraError."""
    texture = textures.resample(textures.GENERATORS["rough"](3, SECONDS), RATE_HZ)
    for codec_name in CODECS:
        stream = vibrocast.encode(texture, codec=codec_name, snr_db=SNR_DB)
        file = pack_file(stream.header, stream.packets)
        live = encode_recording(texture, codec_name=codec_name, snr_db=SNR_DB, live=True).stream
        for core in GCC:
            for (program, level), (compiler, command, flags) in product(PROGRAMS, compilers(core)):
                path = folder / f"{program}-{codec_name}-{core.title}-{compiler}{level}.elf"
                if program == DECODER:
                    emulated = EmulatedCore(compile_decoder(path, flags, codec_name, command), core)
                    ram, per_sample = run(emulated, core, file, None)
                else:
                    emulated = EmulatedCore(compile_controller(path, flags, codec_name, command, level), core)
                    per_sample = play(emulated, core, live)
                    ram = Elf(path).sections[".bss.controller"].size_bytes
                load = 100 * per_sample * RATE_HZ / core.clock_hz
                sizes = emulated.flash_bytes, ram, emulated.stack_bytes
                yield Row(core.title, program, codec_name, level, compiler, *sizes, per_sample, load)


@page.study
def main(out: Path) -> None:
    """Count flash, stack and load by zig and by GCC, and write their part of firmware.md."""
    with tempfile.TemporaryDirectory() as folder:
        rows = list(measure(Path(folder)))
    commands = [command for core in (CORES["M0+"], RISC_V) for _, command, _ in compilers(core)]
    versions = dict.fromkeys(map(version, commands))
    text = page.render("compilers", globals(), rows=rows, versions=versions, counted=COUNTED.title)
    page.publish(out, "firmware", text, [(TABLE, rows, Row)])


if __name__ == "__main__":
    main()
