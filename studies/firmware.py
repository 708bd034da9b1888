"""Counts in emulation the cost of decoding on a microcontroller: `python -m studies.firmware --out docs/benchmarks`."""

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from studies import page
from studies.emulated_core import (
    CORES,
    DECODE,
    DECODERS,
    Core,
    EmulatedCore,
    Run,
    codec_of,
    compile_core,
    decode,
    functions_of,
    members_of,
    state_bytes,
)
from vibrocast import codec
from vibrocast.codec import Signal, Stream
from vibrocast.codec.encoding import middle
from vibrocast.codec.source import live_format
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT
from vibrocast.evaluation import trained
from vibrocast.evaluation.points import Row, read_rows, write_rows
from vibrocast.evaluation.tables import as_rows, frame
from vibrocast.firmware.build import size as firmware_size
from vibrocast.host import hand_playback, live
from vibrocast.host.devices import Session
from vibrocast.host.live_playback import LivePlayback
from vibrocast.models import Model
from vibrocast.planner import costs, playing
from vibrocast.planner.costs import board_cores, quiet_part
from vibrocast.textures.generate import GENERATORS

RATE_HZ = 2800
SECONDS = 0.5
TARGET_DB = 10.0
QUALITIES_DB = (5.0, 10.0, 20.0)
CHANNELS = (1, 2, 4)
"""For how many a decoder is compiled."""
TABLES = Path(costs.__file__).parent / "data"
"""Folder of the figures as CSV, where an installed planner finds them too."""
BOARD = "stm32f405"
SMALL = {
    "VC_BUFFER_SAMPLES": 4096,
    "VC_BUFFER_PACKETS": 64,
    "VC_BUFFER_BYTES": 8192,
    "VC_PACKET_SAMPLES": 1024,
    "VC_CAPTURE_SAMPLES": 0,
}
"""Buffers of a controller that plays streams as they come: half a second of 8 kHz, no captures."""
DSP, PORTABLE = "DSP instructions", "portable C"
_SWITCHES: dict[str, dict[str, int]] = {DSP: {}, PORTABLE: {"VC_PORTABLE": 1}}


@dataclass(frozen=True)
class Load:
    """The cost of decoding one texture, per sample. `cycles`: of a Cortex-M4 by the page's model, None for others."""

    decoder: str
    texture: str
    snr_db: float
    bits_per_sample: float
    core: str
    kernels: str
    instructions: float
    cycles: float | None
    stack_bytes: int


@dataclass(frozen=True)
class Decoding:
    """The cost of decoding one texture on a Cortex-M4F with DSP kernels, in instructions per sample.

    `block`: the codec's `block_parameter`, empty where it has one length only. `bits_per_sample`, `quiet`: the
    variables of the cost; the latter as planner.costs.quiet_part.
    """

    decoder: str
    block: str
    texture: str
    bits_per_sample: float
    quiet: float
    instructions: float


@dataclass(frozen=True)
class Size:
    """Bytes of a decoder for a Cortex-M4F: code with its constants, model image, and state for its channels."""

    decoder: str
    kernels: str
    code_bytes: int
    image_bytes: int
    state_1_bytes: int
    state_2_bytes: int
    state_4_bytes: int


@dataclass(frozen=True)
class Playing:
    """A live stream of `mdct`, or a profile over position, that a whole controller plays."""

    unit: str
    rate_hz: int
    channels: int
    packet_samples: int


@dataclass(frozen=True)
class ControllerLoad(Playing):
    """The cost of a whole controller.

    `board`: of board_cores. `instructions`, `decoding`: in a second, all, and decoding alone.
    `flash_bytes`, `ram_bytes`: of BOARD's firmware with the buffers of SMALL, but for the code and the state of its
    decoders.
    """

    board: str
    instructions: float
    decoding: float
    flash_bytes: int
    ram_bytes: int


PLAYED = (
    *(Playing("m/s^2", RATE_HZ, channels, 128) for channels in CHANNELS),
    Playing("full scale", RATE_HZ, 1, 128),
    Playing("full scale", 1000, 2, 64),
    Playing("m/s^2", 1000, 1, 64),
    Playing("m/s^2", RATE_HZ, 1, 32),
    Playing("m/s^2", RATE_HZ, 1, 512),
    Playing(PROFILE_UNIT, 100_000, 1, 1024),
)
"""Streams that differ in all that a controller's load depends on besides decoding; profiles' rates are per metre."""
TABLE_NAMES: dict[type[Any], str] = {
    Load: "firmware_loads.csv",
    Size: "firmware_sizes.csv",
    ControllerLoad: "firmware_controller.csv",
    Decoding: "firmware_decoding.csv",
}
PLAYED_SECONDS = 2.0
PROFILE_SAMPLES = 4096
PROFILE_SPEED_MM_S = 100.0


def texture(kind: str) -> Signal:
    """Return SECONDS of a generated texture (n, 1) with a peak of 1."""
    samples = GENERATORS[kind](seed=0, seconds=SECONDS, rate_hz=RATE_HZ).samples
    peak: float = np.abs(samples).max()
    return samples / peak


@cache
def coded(decoder: str, kind: str) -> tuple[Stream, float]:
    """Return a texture as it is streamed, near TARGET_DB or the next better quality there is, and its SNR in dB.

    By a codec that keeps no waveform, as finely as its set of rate points goes.
    """
    model = _model(decoder)
    signal = texture(kind)
    name = codec_of(decoder)
    if codec.CODECS[name].keeps_waveform:
        source = codec.Source.of(signal, RATE_HZ, name, live=True, model=model)
        stream = codec.encode_to_snr(source, TARGET_DB)
    else:
        finest = codec.CODECS[name].rate_points[-1]
        stream = codec.encode(signal, RATE_HZ, finest, codec=name, live=True)
    snr_db = codec.snr_db(signal, stream.decode())
    assert snr_db is not None, "textures are not silent"
    return stream, snr_db


def measure_loads(folder: Path, decoders: Iterable[str], kinds: Sequence[str]) -> Iterator[Load]:
    """Yield what decoding takes on each core with each kernels; programs are built in `folder`.

    Raises BuildError, and AssertionError where an emulated decoder gives other samples than the host.
    """
    for core_name, core in CORES.items():
        for kernels in _SWITCHES:
            program = _program(folder, core, kernels, {codec_of(decoder) for decoder in decoders})
            for decoder in decoders:
                for kind in kinds:
                    stream, snr_db = coded(decoder, kind)
                    run = decode(program, core, stream)
                    is_exact = np.array_equal(run.decoded, stream.decode_integers())
                    assert is_exact, f"{decoder} decodes {kind} differently on {core_name}"
                    yield Load(
                        decoder,
                        kind,
                        round(snr_db, 2),
                        bits_per_sample(stream, run),
                        core_name,
                        kernels,
                        round(run.instructions, 1),
                        round(run.cycles, 1) if core_name == "M4F" else None,
                        run.stack_bytes,
                    )


def bits_per_sample(stream: Stream, run: Run) -> float:
    """Return the bits of packets for each decoded sample."""
    return round(8 * sum(map(len, stream.packets)) / len(run.decoded), 4)


def measure_decoding(folder: Path, decoders: Iterable[str], kinds: Sequence[str]) -> Iterator[Decoding]:
    """Yield what decoding takes at every length of block and some qualities. Raises BuildError."""
    core = CORES["M4F"]
    for decoder in decoders:
        name = codec_of(decoder)
        program = _program(folder, core, DSP, {name})
        known = codec.CODECS[name]
        for block in known.blocks or ("",):
            for kind, stream in _qualities(decoder, known.block_setting(block), kinds):
                run = decode(program, core, stream)
                bits, quiet = bits_per_sample(stream, run), round(quiet_part(run.decoded), 4)
                yield Decoding(decoder, block, kind, bits, quiet, round(run.instructions, 1))


def _qualities(decoder: str, given: codec.Setting, kinds: Sequence[str]) -> Iterator[tuple[str, Stream]]:
    """Yield textures as they are streamed at several qualities.

    At QUALITIES_DB, by every third member of a family of models, or at each rate point of a codec without a waveform.
    """
    name, members = codec_of(decoder), members_of(decoder)
    for kind in kinds:
        signal = texture(kind)
        if len(members) > 1:
            for model in members[::3]:
                yield kind, codec.encode(signal, RATE_HZ, given, codec=name, live=True, model=model)
        elif codec.CODECS[name].keeps_waveform:
            for snr_db in QUALITIES_DB:
                source = codec.Source.of(signal, RATE_HZ, name, live=True, model=members[0] if members else None)
                yield kind, codec.encode_to_snr(source, snr_db, given)
        else:
            for rate_point in codec.CODECS[name].rate_points:
                yield kind, codec.encode(signal, RATE_HZ, {**rate_point, **given}, codec=name, live=True)


def measure_sizes(folder: Path, decoders: Iterable[str]) -> Iterator[Size]:
    """Yield the bytes of each decoder with each kernels. Raises BuildError."""
    core = CORES["M4F"]
    for decoder in decoders:
        name, model = codec_of(decoder), _model(decoder)
        for kernels in _SWITCHES:
            built = [EmulatedCore(_program(folder, core, kernels, {name}, channels), core) for channels in CHANNELS]
            states = [state_bytes(emulated_core, name) for emulated_core in built]
            image = trained.flash_bytes(model) if model else 0
            yield Size(decoder, kernels, built[0].flash_bytes, image, *states)


def measure_controllers(folder: Path) -> Iterator[ControllerLoad]:
    """Yield what each emulated controller takes to play PLAYED, as far as it has the channels. Raises BuildError."""
    sizes = {channels: _rest_bytes(folder, CORES["M4F"], channels) for channels in CHANNELS}
    for board, core_name in board_cores().items():
        core = CORES[core_name]
        program = _program(folder, core, DSP, {"mdct"}, max(CHANNELS))
        for played in PLAYED:
            with playing.opened(board, None) as (session, counter):
                if played.channels > session.controller.description.limits.channels:
                    continue
                long_s = PROFILE_SAMPLES / played.rate_hz if played.unit == PROFILE_UNIT else PLAYED_SECONDS
                samples = GENERATORS["rough"](seed=0, seconds=long_s, rate_hz=played.rate_hz).samples
                signal = np.repeat(samples / np.abs(samples).max(), played.channels, axis=1)
                instructions, decoding = _play(session, counter, signal, played, program, core)
            yield ControllerLoad(
                **asdict(played),
                board=board,
                instructions=round(instructions),
                decoding=round(decoding),
                flash_bytes=sizes[played.channels][0],
                ram_bytes=sizes[played.channels][1],
            )


def _play(
    session: Session,
    counter: playing.InstructionCounter,
    signal: Signal,
    played: Playing,
    program: Path,
    core: Core,
) -> tuple[float, float]:
    """Play a signal; return the instructions a second that it took, and of these what decoding takes while playing."""
    framing = codec.Framing(played.packet_samples, 0)
    if played.unit == PROFILE_UNIT:
        profile = codec.encode(signal, played.rate_hz, {}, unit=PROFILE_UNIT, live=True, framing=framing)
        length_mm = 1e3 * len(signal) / played.rate_hz
        movement = hand_playback.back_and_forth(length_mm, PROFILE_SPEED_MM_S, 1)
        hand_playback.play(session.controller, profile, movement, lambda _: counter.note())
        per_second = counter.take_per_second()
        assert per_second is not None, "emulated processors are counted"
        return per_second, 0.0
    channels = played.channels
    stream = live.LiveStream(
        session.controller,
        live_format(played.rate_hz, played.unit, [1.0] * channels, [0.3] * channels),
        coding=live.LiveCoding(packet_samples=played.packet_samples),
    )
    live_playback = LivePlayback(session, stream, "rough")
    sent_stream = live_playback.play(live_playback.paced(signal), lambda _: counter.note()).stream
    per_second = counter.take_per_second()
    assert per_second is not None and sent_stream is not None, "emulated processors are counted"
    return per_second, decode(program, core, sent_stream).instructions * played.rate_hz


def _rest_bytes(folder: Path, core: Core, channels: int) -> tuple[int, int]:
    """Return flash and RAM of a small controller but for its decoders, which share one memory. Raises BuildError."""
    whole = firmware_size(BOARD, {**SMALL, "VC_CHANNELS": channels, "VC_MAX_CHANNELS": channels})
    names = {codec_of(decoder) for decoder in DECODERS}
    decoders = EmulatedCore(_program(folder, core, DSP, names, channels), core)
    return whole.flash - decoders.flash_bytes, whole.ram - max(state_bytes(decoders, name) for name in names)


def _program(folder: Path, core: Core, kernels: str, codecs: set[str], channels: int = 1) -> Path:
    name = "-".join((*sorted(codecs), core.title, kernels.split()[0], str(channels)))
    switches = {"VC_MAX_CHANNELS": channels, **_SWITCHES[kernels]}
    return compile_core(folder / f"{name}.elf", core, functions_of(codecs, DECODE), switches)


def _model(decoder: str) -> Model | None:
    """Return the middle model of a family, near TARGET_DB; None for a codec's own name."""
    members = members_of(decoder)
    return middle(members) if members else None


def rendered(loads: Sequence[Load], sizes: Sequence[Size], controller: Sequence[ControllerLoad]) -> str:
    """Return the page."""
    means = mean_loads(loads)
    decoders = list(dict.fromkeys(load.decoder for load in loads))
    m4_percent = {decoder: means[decoder, "M4F", DSP].cycles_percent for decoder in decoders}
    return page.render(
        "firmware",
        globals(),
        textures=list(dict.fromkeys(load.texture for load in loads)),
        others=[name for name in CORES if name != "M4F"],
        decoders=decoders,
        loads=means,
        fitting=[decoder for decoder in decoders if m4_percent[decoder] < 100],
        lightest=min(decoders, key=lambda decoder: m4_percent[decoder]),
        heaviest=max(decoders, key=lambda decoder: m4_percent[decoder]),
        too_slow=[decoder for decoder in decoders if means[decoder, "M4F", PORTABLE].cycles_percent > 100],
        memory={(size.decoder, size.kernels): size for size in sizes},
        controllers=[(load, CORES[board_cores()[load.board]].clock_hz) for load in controller],
    )


def stored(kind: type[Row]) -> list[Row]:
    """Return the rows of the table of this kind. Raises OSError."""
    return read_rows(TABLES / TABLE_NAMES[kind], kind)


def mean_loads(loads: Sequence[Load]) -> dict[tuple[str, str, str], Any]:
    """Return what decoders take by decoder, core and kernels: means over the textures, and the most.

    `load_percent`, `max_percent`: of the core by instructions; `cycles_percent`: by cycles. Other columns as of Load.
    """
    hz = pl.DataFrame({"core": list(CORES), "clock_hz": [core.clock_hz for core in CORES.values()]})
    means = pl.col("instructions", "cycles", "bits_per_sample").mean()
    most = pl.col("instructions").max().alias("most"), pl.col("stack_bytes").max()
    table = frame(loads, Load).join(hz, on="core").group_by("decoder", "core", "kernels", "clock_hz").agg(means, *most)
    percent = {
        name: 100 * pl.col(column) * RATE_HZ / pl.col("clock_hz")
        for name, column in (("load_percent", "instructions"), ("max_percent", "most"), ("cycles_percent", "cycles"))
    }
    return {(row.decoder, row.core, row.kernels): row for row in as_rows(table.with_columns(**percent))}


@page.study
@page.FROM_TABLES
def main(out: Path, from_tables: bool) -> None:
    """Count what decoding costs a Cortex-M and write its part of firmware.md."""
    if not from_tables:
        with tempfile.TemporaryDirectory() as temporary:
            folder, kinds = Path(temporary), list(GENERATORS)
            measured: dict[type[Any], list[Any]] = {
                Load: list(measure_loads(folder, DECODERS, kinds)),
                Size: list(measure_sizes(folder, DECODERS)),
                ControllerLoad: list(measure_controllers(folder)),
                Decoding: list(measure_decoding(folder, DECODERS, kinds)),
            }
        for kind, rows in measured.items():
            write_rows(TABLES / TABLE_NAMES[kind], rows, kind)
    page.write(out, "firmware", rendered(stored(Load), stored(Size), stored(ControllerLoad)), from_tables)


if __name__ == "__main__":
    main()
