"""What a codec costs: processor time, delay, memory and decoder size; run directly, it counts the decoders' bytes."""

import json
import math
import multiprocessing
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from timeit import Timer
from typing import TypeVar

import click
import numpy as np

from vibrocast import codec
from vibrocast.codec import Framing, Setting, SignalFormat
from vibrocast.evaluation import trained
from vibrocast.files import atomic_write
from vibrocast.models import Model

T = TypeVar("T")

MIN_S = 0.01
"""Shorter work is timed in so many runs at a time that together they take about so long, far above a clock's step."""
MEMORY_SECONDS, MEMORY_RATE_HZ = 100, 2800
DECODER_SIZES = Path(__file__).parent / "data" / "decoder_sizes.json"

_CORE = Path(__file__).parents[1] / "firmware" / "core"
_TARGET = ("-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp")
_FLAGS = ("-Os", "-std=c99", "-ffreestanding", "-fno-builtin", "-ffunction-sections", "-fdata-sections", "-g0")


@dataclass(frozen=True)
class DecoderSize:
    """Bytes of a codec's decoder, None where they cannot be told, and what was counted or why it was not."""

    bytes: int | None
    note: str


@dataclass(frozen=True)
class CodecCost:
    """What a codec, or `coder` with a family of models, costs whatever the signal; None where that is not known.

    `decoder_bytes`: of the decoder's code, `note` says what they count. `model_bytes`: of the images of a family of
    models without their ONNX graphs, which no microcontroller runs; None for a codec without models. `width`: channels
    of a model's hidden layers.
    """

    codec: str
    decoder_bytes: int | None
    peak_memory_bytes: int | None
    note: str
    model_bytes: int | None = None
    coder: str = ""
    width: int | None = None

    @property
    def flash_bytes(self) -> int | None:
        """What a controller holds to decode: code and models."""
        return None if self.decoder_bytes is None else self.decoder_bytes + (self.model_bytes or 0)


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


def delay_ms(
    codec_name: str,
    setting: Setting,
    rate_hz: int,
    channels: int = 1,
    unit: str = "full scale",
    model: Model | None = None,
) -> float:
    """Return the algorithmic delay: from a sample's arrival to its play-out, were computing and transport instant.

    The codec's shortest packet, whose first sample waits for its last, and the samples by which decoded signal lags
    (overlap and lookahead): what the codec itself cannot do without, however many blocks a packet then holds. Raises
    CodecError where the codec does not have the setting, rate or channels.
    """
    signal_format = SignalFormat(rate_hz, unit, gains=(1.0,) * channels, rms=(1.0,) * channels)
    plug_in = codec.codec_by_name(codec_name)
    encoder = plug_in.make_encoder(
        plug_in.complete(setting), signal_format, Framing(1, 1), trained.for_encoder(model) if model else None, None
    )
    return 1e3 * (encoder.packet_samples + encoder.delay_samples) / rate_hz


def peak_memory_bytes(codec_name: str, model: Model | None = None) -> int | None:
    """Return the resident memory that coding adds at its peak to a fresh process; None on Windows.

    The process encodes and decodes 100 s of Gaussian noise, RMS 0.1, one channel at 2800 Hz, at the codec's default
    setting. What it held before, libraries and tables included, is that after coding a tenth of a second.
    """
    if sys.platform == "win32":
        return None
    # Not "spawn": on Linux what a large process starts begins with its peak; what the fork server starts does not.
    with ProcessPoolExecutor(1, multiprocessing.get_context("forkserver")) as fresh:
        return fresh.submit(_memory_added, codec_name, model).result()


def _memory_added(codec_name: str, model: Model | None) -> int:
    noise = np.random.default_rng(0).normal(0, 0.1, (MEMORY_SECONDS * MEMORY_RATE_HZ, 1))
    before = 0
    for part in (noise[: MEMORY_RATE_HZ // 10], noise):
        before = _peak_resident_bytes()
        for_encoder = trained.for_encoder(model) if model else None
        coded = codec.encode(part, MEMORY_RATE_HZ, {}, codec=codec_name, model=for_encoder)
        codec.decode(coded, model.tables if model else None)
    return _peak_resident_bytes() - before


def _peak_resident_bytes() -> int:
    import resource  # Windows has none

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def decoder_bytes(codec_name: str) -> int | None:
    """Return the bytes of the codec's decoder, as docs/metrics.md counts them; None where they cannot be told."""
    return _decoder_size(codec_name).bytes


def measure_costs(
    wanted: Mapping[str, tuple[str, Sequence[Model]]],
    progress: Callable[[float, str], None] = lambda part, details: None,
) -> list[CodecCost]:
    """Return what each of these costs, a codec and perhaps a family of models by a name of its own.

    Where one fails to code, its note says so, and its memory is None. `progress` is called with the part done, from 0
    to 1, and the name of what was measured.
    """
    costs = []
    for place, (name, (codec_name, models)) in enumerate(wanted.items(), 1):
        size = _decoder_size(codec_name)
        cost = CodecCost(name, size.bytes, None, size.note, coder=codec_name)
        if models:
            note = f"{size.note}; model: {len(models)} images" if len(models) > 1 else size.note
            model_bytes = sum(map(trained.flash_bytes, models))
            cost = replace(cost, model_bytes=model_bytes, note=note, width=trained.width(models[0]))
        try:
            costs.append(replace(cost, peak_memory_bytes=peak_memory_bytes(codec_name, models[0] if models else None)))
        except Exception as error:  # whatever one codec raises, the others' costs are wanted
            costs.append(replace(cost, note=f"{cost.note}; memory not measured: {error}"))
        progress(place / len(wanted), name)
    return costs


def _decoder_size(codec_name: str) -> DecoderSize:
    return _decoder_sizes().get(codec_name, DecoderSize(None, "decoder not counted"))


@cache
def _decoder_sizes() -> dict[str, DecoderSize]:
    return {name: DecoderSize(**size) for name, size in json.loads(DECODER_SIZES.read_text(encoding="utf-8")).items()}


def count_decoder_size(codec_name: str) -> DecoderSize:
    """Count the bytes of a codec's decoder: compiled where it is in the C core, else in PyAV's wheel.

    Raises click.ClickException where the core cannot be compiled.
    """
    if functions := _decoder_functions(codec_name):
        compiler = f"ziglang {metadata.version('ziglang')} {_FLAGS[0]}"
        note = f"for Cortex-M4 by {compiler}, without memcpy, memset and the compiler's arithmetic routines"
        return DecoderSize(_linked_bytes(functions), note)
    library = codec.codec_by_name(codec_name).library
    if not library:
        reason = "not in the C core" if library is None else "one of many in libavcodec"
        return DecoderSize(None, f"decoder not counted: {reason}")
    files = [file for file in metadata.files("av") or () if file.name.startswith(library)]
    size = sum(Path(str(file.locate())).stat().st_size for file in files)
    return DecoderSize(
        size or None, f"{library} of PyAV {metadata.version('av')}, {platform.machine()}, encoder included"
    )


def _decoder_functions(codec_name: str) -> list[str]:
    """Return the core's functions that decode for a codec, as its headers declare them; none for other codecs."""
    headers = "\n".join(path.read_text(encoding="utf-8") for path in _CORE.glob("*.h"))
    return sorted(set(re.findall(rf"\bvc_{re.escape(codec_name)}_(?:decode\w*|conceal)(?=\()", headers)))


def _linked_bytes(functions: list[str]) -> int:
    """Return the size of the image with these functions, all that they need, and nothing else."""
    zig = [sys.executable, "-m", "ziglang"]
    with tempfile.TemporaryDirectory() as folder:
        sources = sorted(str(path) for path in _CORE.glob("*.c"))
        _run([*zig, "cc", "-c", *_TARGET, *_FLAGS, "-fno-unwind-tables", *sources], folder)
        roots = [f"--undefined={name}" for name in functions]
        layout = ["--gc-sections", "--omagic", "--entry=0", "--oformat=binary", "--unresolved-symbols=ignore-all"]
        objects = sorted(path.name for path in Path(folder).glob("*.o"))
        _run([*zig, "ld.lld", *layout, *roots, *objects, "-o", "decoder.bin"], folder)
        return (Path(folder) / "decoder.bin").stat().st_size


def _run(command: list[str], folder: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise click.ClickException(f"the core cannot be compiled:\n{done.stderr}")


@click.command()
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), default=DECODER_SIZES, show_default="as shipped"
)
def main(out: Path) -> None:
    """Count the bytes of every codec's decoder and write them as JSON; in a checkout, with ziglang installed."""
    if not _CORE.is_dir() or find_spec("ziglang") is None:
        raise click.ClickException("the core is compiled to count it: run in a checkout, after `pip install ziglang`")
    sizes = {name: asdict(count_decoder_size(name)) for name in codec.CODECS}
    try:
        with atomic_write(out) as path:
            path.write_text(json.dumps(sizes, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise click.ClickException(f"{out}: cannot be written: {error.strerror}") from error
    for name, size in sizes.items():
        click.echo(f"{name}: {size['bytes'] or 'no'} bytes ({size['note']})")


if __name__ == "__main__":
    main()
