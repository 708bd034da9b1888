"""Searches for the streams that cost a board most: `python -m studies.worst_case --out docs/benchmarks`."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import unicorn

from studies import page
from studies.emulated_core import (
    CORES,
    DECODE_IN_BLOCKS,
    DECODERS,
    Costs,
    EmulatedCore,
    codec_of,
    compile_core,
    decode_in_blocks,
    functions_of,
    members_of,
)
from vibrocast import codec
from vibrocast.codec import Framing, Setting, Stream
from vibrocast.codec.core import decoding_cycles
from vibrocast.codec.eva_image import EvaImage
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.layout import pack_varint
from vibrocast.device_protocol.messages import Configure, ErrorCode, Start, Status, Stop, StreamData
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.evaluation import points
from vibrocast.firmware.build import build
from vibrocast.firmware.elf import Elf
from vibrocast.harness.boards.stm32f405 import Stm32F405
from vibrocast.host import uploader
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.models import Model
from vibrocast.simulated_device.memory_link import MemoryLink

BOARD = "stm32f405"
CHANNELS = (1, 2)
RATE_HZ = 2800
NOISE_DB = 30.0
"""SNR of the noise that the firmware's own figures stand for."""
TRIES = 100
"""Changes of each hostile stream that the search tries."""
BOARD_RATES_HZ = (2800, 12_000)
STOPS = 6
"""Moments at which a Stop is tried."""
COSTS = "worst_case_costs.csv"
TURNS = "worst_case_turns.csv"
_CORE = CORES["M4F"]
_PACKETS = 3
_NOISE_SAMPLES = 4096
_MOST_PACKET_BYTES = 2000  # the board takes no longer ones
_BYTES_PER_SAMPLE = 7  # as many as the board's line carries at the highest of BOARD_RATES_HZ
_PLAYED_S = 0.15
_BETWEEN_STOPS_S = 0.0017
_STEP_S = 0.002
_SETTINGS: dict[str, list[Setting]] = {
    "mdct": [{"step": 1e-5, "noise_filling": 0.1}, {"step": 0.01}],
    "dct": [
        {"quantiser": quantiser, "levels": 65535, "entropy": entropy}
        for quantiser, entropy in product(("linear", "log"), ("huffman", "range"))
    ],
    "slp": [{"quality": quality, "order": 16} for quality in (16, 31)],
    "parametric": [
        {"bands": "sixth octave", "step_db": "0.75", "frame": frame, "interval": "1"} for frame in ("1", "4")
    ],
    "eva": [{}],
}
"""Where the search begins, with full-scale noise: settings for many decisions in each sample."""


@dataclass(frozen=True)
class Cost:
    """Cycles of a Cortex-M4 that a decoder takes, at one length of block.

    `noise_cycles`: for a sample of all channels, of noise at NOISE_DB, or the finest that a codec without an SNR has.
    `stated_cycles`: the figure of the firmware for it. The others belong to the most expensive stream found:
    `hostile_cycles` for a sample, `feed_cycles` to take a packet, `block_cycles` for one call of the decoder.
    """

    decoder: str
    block: str
    channels: int
    noise_cycles: int
    stated_cycles: int
    hostile_cycles: int
    feed_cycles: int
    block_cycles: int


@dataclass(frozen=True)
class Turn:
    """The behaviour of an emulated board that plays the most expensive stream found for a decoder.

    `turn_ms`: the longest turn of the main loop; None where the board rejects the stream at Configure, and then the
    rest is None as well. `stop_ms`: the longest time from a Stop on the wire to the
    DAC's code that goes to rest. `gaps`, and `late_samples` of the DAC: as Status has them.
    """

    decoder: str
    channels: int
    rate_hz: int
    turn_ms: float | None = None
    stop_ms: float | None = None
    gaps: int | None = None
    late_samples: int | None = None


def finest_model(decoder: str) -> Model | None:
    """Return the model of a family that spends most bits; None for a codec's own name."""
    return next(reversed(members_of(decoder)), None)


@dataclass(frozen=True)
class Hostile:
    """Packets that cost much, the stream that they are to be part of, the payload of its model, and their decoder."""

    decoder: str
    stream: Stream
    tables: bytes | None
    packets: list[bytes]

    def image(self) -> bytes | None:
        """Return the unsigned image of the model; None for a codec without one."""
        model = finest_model(self.decoder)
        if model is None or self.tables is None:
            return None
        return replace(ModelImage.unpack(model.image), payload=self.tables, number=0, signature=b"").pack()

    def header(self, rate_hz: int) -> StreamHeader:
        """Return the header of the stream at another rate."""
        own, image = self.stream.header, self.image()
        identifier, gains = codec.CODECS[self.stream.codec_name].identifier, (1.0,) * own.channels
        image_hash = b"" if image is None else sha256(image)[:4]
        return StreamHeader(identifier, rate_hz, None, "full scale", gains, own.configuration, image_hash)


def emulated(folder: Path) -> EmulatedCore:
    """Return a processor with all decoders, which are compiled in `folder`. Raises BuildError."""
    functions = functions_of(_SETTINGS, DECODE_IN_BLOCKS)
    program = compile_core(folder / "decoders.elf", _CORE, functions, {"VC_MAX_CHANNELS": max(CHANNELS)})
    return EmulatedCore(program, _CORE)


def measure(processor: EmulatedCore, decoder: str, block: str, channels: int, tries: int) -> tuple[Cost, Hostile]:
    """Return the cost of a decoder, and the most expensive stream that was found."""
    of_noise = noise(processor, decoder, block, channels)
    most, hostile = costliest(processor, decoder, block, channels, tries)
    of_hostile = round(most.sample_cycles), most.feed_cycles, most.block_cycles
    return Cost(decoder, block, channels, *of_noise, *of_hostile), hostile


def noise(processor: EmulatedCore, decoder: str, block: str, channels: int) -> tuple[int, int]:
    """Return the cycles that a sample of noise takes, and the firmware's figure for it."""
    name, model = codec_of(decoder), finest_model(decoder)
    known = codec.CODECS[name]
    signal = np.random.default_rng(0).uniform(-1, 1, (_NOISE_SAMPLES, channels))
    setting = known.block_setting(block)
    if name in ("eva", "parametric"):
        finest = {**_SETTINGS[name][0], **setting}
        stream = codec.encode(signal, RATE_HZ, finest, codec=name, live=True, model=model)
    else:
        source = codec.Source.of(signal, RATE_HZ, name, live=True, model=model)
        stream = codec.encode_to_snr(source, NOISE_DB, setting)
    costs = decode_in_blocks(processor, stream, stream.tables, stream.packets)
    stated = decoding_cycles(known.identifier, stream.header.configuration, channels, stream.tables)
    return round(costs.sample_cycles), stated


def costliest(processor: EmulatedCore, decoder: str, block: str, channels: int, tries: int) -> tuple[Costs, Hostile]:
    """Return the most of each cost that came up, and the packets that took most cycles for a sample."""
    name, model = codec_of(decoder), finest_model(decoder)
    known, random = codec.CODECS[name], np.random.default_rng(channels)
    signal = 0.99 * random.choice([-1.0, 1.0], (_PACKETS * max(128, int(block or 1)), channels))
    begun: list[tuple[Costs, Hostile]] = []
    for setting, packet_samples, refresh_packets in product(_SETTINGS[name], (1, 128), (1, 0)):
        framing, whole = Framing(packet_samples, refresh_packets), {**setting, **known.block_setting(block)}
        stream = codec.encode(signal, RATE_HZ, whole, codec=name, live=True, model=model, framing=framing)
        most_bytes = min(_MOST_PACKET_BYTES, _BYTES_PER_SAMPLE * stream.packet_samples)
        for tables in hostile_tables(name, model):
            for packets in filled(list(stream.packets[:_PACKETS]), most_bytes, random):
                hostile = Hostile(decoder, stream, tables, packets)
                begun.append((cost_of(processor, hostile), hostile))
    begun.sort(key=lambda one: -one[0].sample_cycles)
    climbed = [climb(processor, *one, tries, random) for one in begun[:2]]
    most = climbed[0][0]
    for costs, _ in (*begun, *climbed):
        most = most.most(costs)
    return most, max(climbed, key=lambda one: one[0].sample_cycles)[1]


def cost_of(processor: EmulatedCore, hostile: Hostile) -> Costs:
    """Return what the packets take."""
    return decode_in_blocks(processor, hostile.stream, hostile.tables, hostile.packets)


def hostile_tables(name: str, model: Model | None) -> Iterator[bytes | None]:
    """Yield a model's tables, and for EVA also those by which each level is great, or zero, at the cost of few bits."""
    yield None if model is None else model.tables
    if name == "eva" and model is not None:
        image = EvaImage.unpack(model.tables)
        for probability in (0, 65535):
            greatest = np.full_like(image.probabilities, probability)
            yield replace(image, probabilities=greatest, graph=b"").pack()


def filled(packets: list[bytes], most_bytes: int, random: np.random.Generator) -> Iterator[list[bytes]]:
    """Yield the packets, and ones with zeros, ones and random bits behind the same head, of at most `most_bytes`."""
    yield [packet[:most_bytes] for packet in packets]
    behind = most_bytes - 1
    for content in (bytes(behind), b"\xff" * behind, random.bytes(behind)):
        yield [packet[:1] + content for packet in packets]


def climb(
    processor: EmulatedCore, costs: Costs, hostile: Hostile, tries: int, random: np.random.Generator
) -> tuple[Costs, Hostile]:
    """Change bytes, and keep each change after which a sample takes no less. Return the most of each cost."""
    most = costs
    for _ in range(tries):
        number = int(random.integers(len(hostile.packets)))
        changed = replace(hostile, packets=list(hostile.packets))
        changed.packets[number] = changed_bytes(hostile.packets[number], random)
        found = cost_of(processor, changed)
        most = most.most(found)
        if found.sample_cycles >= costs.sample_cycles:
            costs, hostile = found, changed
    return most, hostile


def changed_bytes(packet: bytes, random: np.random.Generator) -> bytes:
    """Return a packet with another piece of 1 to 128 bytes somewhere behind its head."""
    start = int(random.integers(min(1, len(packet) - 1), len(packet)))
    length = min(int(2 ** random.integers(0, 8)), len(packet) - start)
    pieces = (random.bytes(length), bytes(length), b"\xff" * length)
    return packet[:start] + pieces[random.integers(len(pieces))] + packet[start + length :]


class Board:
    """An emulated Feather STM32F405 that plays a hostile stream live."""

    def __init__(self, hostile: Hostile, turn: Turn) -> None:
        """Flash the model, and configure the stream. Raises ControllerError where the board rejects it."""
        self._device = Stm32F405()
        self._link = MemoryLink(self._device)
        self._host = Controller(self._link, self._link.clock, self._link.sleep)
        self._hostile, self._turn, self._sent, self._dropped_us = hostile, turn, 0, 0.0
        drop = Elf(build(BOARD)).symbols["drop"] & ~1  # of the DAC's driver; the next code goes to rest
        self._device.processor.unicorn.hook_add(unicorn.UC_HOOK_CODE, self._drop, None, drop, drop)
        if (image := hostile.image()) is not None:
            uploader.flash(self._host, image)
        stream = hostile.stream
        self._packet_samples = (
            codec.CODECS[stream.codec_name]
            .make_decoder(stream.header.configuration, stream.header.channels, hostile.tables)
            .packet_samples
        )
        self._configure = Configure(1, hostile.header(turn.rate_hz).pack(), self._packet_samples)
        self._host.request(self._configure, Status)

    def play(self, stop_after_s: float) -> Turn:
        """Play the stream from its beginning, and stop it a moment after its last packet came."""
        link, device = self._link, self._device
        self._host.request(self._configure, Status)
        self._sent = 0
        self._host.request(Start(), Status)
        end_us = link.now_us + 1e6 * _PLAYED_S
        device.longest_turn_us()
        while link.now_us < end_us:
            self._send(self._host.request_status().credit_until)
            link.sleep(_STEP_S)
        status = self._host.request_status()
        link.sleep(stop_after_s)
        stopped_us = device.now_us
        self._host.request(Stop(), Status)
        return replace(
            self._turn,
            turn_ms=round(device.longest_turn_us() / 1000, 2),
            stop_ms=round((self._dropped_us - stopped_us) / 1000, 2),
            gaps=status.output_gaps,
            late_samples=status.late_samples,
        )

    def _send(self, credit_until: int) -> None:
        """Send packets as far as there is credit."""
        while (self._sent + 1) * self._packet_samples <= credit_until:
            packet = self._hostile.packets[self._sent % len(self._hostile.packets)]
            head = pack_varint(2 * self._sent + (packet[0] & 1))
            self._host.send(StreamData(1, 0, (head + packet[1:],)))
            self._sent += 1

    def _drop(self, *_: object) -> None:
        self._dropped_us = self._device.now_us


def on_board(hostile: Hostile, rate_hz: int, stops: int) -> Turn:
    """Return the worst of several plays of a hostile stream on the board, each with a Stop at another moment."""
    turn = Turn(hostile.decoder, hostile.stream.header.channels, rate_hz)
    try:
        board = Board(hostile, turn)
    except ControllerError as error:
        if error.code != ErrorCode.BEYOND_LIMITS:
            raise
        return turn
    played = [board.play(number * _BETWEEN_STOPS_S) for number in range(stops)]
    return Turn(*map(max, zip(*(astuple(each) for each in played), strict=True)))


def measured_costs(tries: int) -> Iterator[tuple[Cost, Hostile]]:
    """Yield the costs of each decoder, at each length of block, with the most expensive stream. Raises BuildError."""
    with tempfile.TemporaryDirectory() as folder:
        processor = emulated(Path(folder))
        for decoder, channels in product(DECODERS, CHANNELS):
            for block in codec.CODECS[codec_of(decoder)].blocks or ("",):
                yield measure(processor, decoder, block, channels, tries)


def measured_turns(found: Sequence[tuple[Cost, Hostile]], stops: int) -> Iterator[Turn]:
    """Yield what the board does with the stream of the longest block, for each decoder, channel count and rate."""
    costs, streams = zip(*found, strict=True)
    for decoder, channels, rate_hz in product(DECODERS, CHANNELS, BOARD_RATES_HZ):
        hostile = streams[costs.index(of_longest_block(costs, decoder, channels))]
        yield on_board(hostile, rate_hz, stops)


def of_longest_block(costs: Sequence[Cost], decoder: str, channels: int) -> Cost:
    """Return the cost of the block that takes longest."""
    of_decoder = [cost for cost in costs if (cost.decoder, cost.channels) == (decoder, channels)]
    return max(of_decoder, key=lambda cost: cost.block_cycles)


def rendered(costs: Sequence[Cost], turns: Sequence[Turn]) -> str:
    """Return the page."""
    accepted = [turn for turn in turns if turn.turn_ms is not None]
    cycles = [of_longest_block(costs, turn.decoder, turn.channels).hostile_cycles for turn in turns]
    loads = [100 * each * turn.rate_hz / _CORE.clock_hz for each, turn in zip(cycles, turns, strict=True)]
    return page.render(
        "worst_case",
        globals(),
        clock_mhz=_CORE.clock_hz / 1e6,
        costs=costs,
        turns=list(zip(turns, loads, strict=True)),
        accepted=accepted,
        longest_block=max(costs, key=lambda cost: cost.block_cycles),
        longest=max(accepted, key=lambda turn: turn.turn_ms or 0.0),
        latest=max(accepted, key=lambda turn: turn.stop_ms or 0.0),
        late=[turn for turn in accepted if turn.gaps],
        costliest=max(costs, key=lambda cost: cost.hostile_cycles / cost.stated_cycles),
    )


@page.study
@page.FROM_TABLES
def main(out: Path, from_tables: bool) -> None:
    """Search for the streams that take a decoder most time, and play them on an emulated board."""
    if from_tables:
        results = page.results_folder(out)
        stored = points.read_rows(results / COSTS, Cost), points.read_rows(results / TURNS, Turn)
        page.write(out, "firmware", rendered(*stored), redrawn=True)
        return
    found = page.collected("streams", measured_costs(TRIES), None, lambda one: one[0].decoder)
    turns = page.collected("streams", measured_turns(found, STOPS), None, lambda turn: f"{turn.decoder} on a board")
    costs = [cost for cost, _ in found]
    page.publish(out, "firmware", rendered(costs, turns), ((COSTS, costs, Cost), (TURNS, turns, Turn)))


if __name__ == "__main__":
    main()
