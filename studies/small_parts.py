"""Counts what one codec alone takes on four processors: `python -m studies.small_parts --out docs/benchmarks`."""

import struct
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from studies import page, worst_case
from studies.emulated_core import CORES, RISC_V, ZIG, Core, EmulatedCore, codec_of, compile_core
from vibrocast.device_protocol.coded_stream import pack_file
from vibrocast.evaluation import points
from vibrocast.firmware.build import ROOT, only, size
from vibrocast.firmware.native_core import BuildError

DECODERS = ("slp", "parametric", "dct", "mdct", "eva-16")
"""Codecs, and the smallest family of models of those that need one."""
CONTROLLERS = ("small-slp", "small-mdct")
TABLE = "small_parts.csv"
_RAM, _DATA = 0x2000_0000, 0x6000_0000  # as in EmulatedCore
_STREAM, _ARRAY, _PACKET, _MODEL, _FILE, _SAMPLES = (
    _DATA + offset for offset in (0, 0x100, 0x1000, 0x20000, 0x80000, 0xC0000)
)
_PACKET_SAMPLES_AT, _NEEDED_AT = 88, 96  # of a vc_stream, where a pointer has 4 bytes
_FUNCTIONS = ("vc_stream_open", "vc_stream_next", "vc_stream_poll", "vc_array_read")

PROCESSORS = CORES["M0+"], CORES["M4F"], CORES["M33"], RISC_V
"""With the clocks of an RP2040, an STM32F405, an RP2350 and an ESP32-C3."""
COUNTED = CORES["M4F"]
"""The processor whose cycles have a model; of the others, instructions are counted."""


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


def compile_decoder(output: Path, processor: Core, codec_name: str, compiler: Sequence[str] = ZIG) -> Path:
    """Link the decoder of one codec with the reader of files, -Os; return the program. Raises as compile_core."""
    switches = {"VC_MAX_CHANNELS": 1, **only(codec_name.upper())}
    reader = Path(__file__).with_name("array_reader.c")
    return compile_small(output, processor, _FUNCTIONS, switches, [reader], compiler)


def compile_small(
    output: Path,
    processor: Core,
    functions: Sequence[str],
    switches: Mapping[str, int],
    sources: Sequence[Path],
    compiler: Sequence[str] = ZIG,
    level: str = "-Os",
) -> Path:
    """Link functions of the core and of other sources, with memcpy as boards have it. As compile_core otherwise."""
    if processor.arm or compiler != ZIG:
        sources = [*sources, ROOT / "ports" / "cortex_m" / "memory.c"]
    return compile_core(output, processor, functions, switches, (level, "-g1", "-Wl,--gc-sections"), sources, compiler)


def run(core: EmulatedCore, processor: Core, file: bytes, image: bytes | None) -> tuple[int, float]:
    """Decode a file; return the bytes of the decoder's state, and what a sample takes. Raises BuildError."""
    core.write(_FILE, file)
    core.write(_MODEL, image or b"")
    core.write(_ARRAY, struct.pack("<II", _FILE, len(file)))
    given = (core.symbols["vc_array_read"], _ARRAY, _RAM, 1 << 19, _PACKET, 65535)
    model = (_MODEL, len(image)) if image else (0, 0)
    core.write(_STREAM, struct.pack("<8I", *given, *model).ljust(128, b"\0"))
    if core.call("vc_stream_open", _STREAM) != 0:
        raise BuildError("the emulated decoder does not open the stream")
    before = core.cycles, core.instructions
    packet_samples, samples = core.word(_STREAM + _PACKET_SAMPLES_AT), 0
    while (status := core.call("vc_stream_next", _STREAM)) == 0:
        while core.call("vc_stream_poll", _STREAM, _SAMPLES) < packet_samples:
            pass
        samples += packet_samples
    if status != 2 or samples == 0:
        raise BuildError(f"the emulated decoder ends with status {status}")
    spent = core.cycles - before[0] if processor == COUNTED else core.instructions - before[1]
    return core.word(_STREAM + _NEEDED_AT), spent / samples


def hostile_stream(folder: Path, decoder: str) -> tuple[bytes, bytes | None]:
    """Return the file of the most expensive stream that worst_case begins with, and its model image."""
    results = Path(__file__).parents[1] / "docs" / "benchmarks" / "results"
    rows = points.read_rows(results / worst_case.COSTS, worst_case.Cost)
    costs = [row for row in rows if (row.decoder, row.channels) == (decoder, 1)]
    block = max(costs, key=lambda cost: cost.hostile_cycles).block
    _, hostile = worst_case.costliest(worst_case.emulated(folder), decoder, block, 1, 0)
    return pack_file(hostile.header(worst_case.RATE_HZ), hostile.packets), hostile.image()


def measure(folder: Path) -> Iterator[Cost]:
    """Yield the cost of each decoder on each processor. Raises BuildError and MissingExtraError."""
    for decoder in DECODERS:
        file, image = hostile_stream(folder, decoder)
        for processor in PROCESSORS:
            program = compile_decoder(folder / f"{decoder}-{processor.title}.elf", processor, codec_of(decoder))
            core = EmulatedCore(program, processor)
            ram, per_sample = run(core, processor, file, image)
            load = 100 * per_sample * worst_case.RATE_HZ / processor.clock_hz
            yield Cost(processor.title, decoder, core.flash_bytes, ram, core.stack_bytes, per_sample, load)


@page.study
def main(out: Path) -> None:
    """Count flash, RAM, stack and worst-case load of each codec, and write their part of firmware.md."""
    with tempfile.TemporaryDirectory() as folder:
        costs = list(measure(Path(folder)))
    controllers = {name: size(name) for name in CONTROLLERS}
    text = page.render("small_parts", globals(), costs=costs, controllers=controllers)
    page.publish(out, "firmware", text, [(TABLE, costs, Cost)])


if __name__ == "__main__":
    main()
