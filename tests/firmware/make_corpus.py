"""Writes the inputs that fuzzing of the firmware starts from: python -m tests.firmware.make_corpus"""

import itertools
import operator
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.codec.eva_models import random_image, with_extreme_weights
from tests.codec.signals import RATE_HZ, texture
from tests.device_protocol import test_messages
from tests.firmware.fuzzing import CODECS, CORPUS, TARGETS
from vibrocast import codec, models
from vibrocast.codec import eva, mdct
from vibrocast.codec.eva_image import PRIOR_KINDS
from vibrocast.device_protocol import messages
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT, STREAM_UNITS, StreamHeader, pack_file, unpack_file
from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.layout import pack_varint
from vibrocast.device_protocol.messages import (
    CaptureRead,
    Configure,
    EndStream,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashData,
    FlashErase,
    FlashRead,
    FlashVerify,
    Gain,
    Hello,
    HelloResponse,
    Loop,
    Message,
    Pause,
    Position,
    Resume,
    SlotState,
    Start,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
)
from vibrocast.device_protocol.model_image import ModelImage, sha256, with_signature
from vibrocast.export import mdct_tables

FOLDER = Path(__file__).parents[1] / "codec"
IMAGE = ModelImage(4, "oak", "1.0", "board", random_image(1, 2, 2).pack()).pack()


class Golden(NamedTuple):
    """A golden stream; `image`: its model image, empty if it needs none."""

    codec_name: str
    header: StreamHeader
    packets: tuple[bytes, ...]
    image: bytes


def golden_streams() -> list[Golden]:
    """Return the golden streams that controllers decode."""
    found = []
    for name in CODECS:
        for path in sorted(FOLDER.glob(f"golden_{name}*.vct")):
            header, packets = unpack_file(path.read_bytes())
            image = path.with_name(path.name.replace("_steered", "")).with_suffix(".vcmi")
            model = models.by_hash(header.image_hash) if header.image_hash else None
            held = model.image if model else image.read_bytes() if image.exists() else b""
            found.append(Golden(name, header, tuple(packets), held))
    return found


def record(data: bytes) -> bytes:
    """Return a record of the targets whose inputs have several."""
    return len(data).to_bytes(2, "little") + data


def stream(configuration: bytes, packets: Sequence[bytes], models: Sequence[bytes] = (), channels: int = 2) -> bytes:
    """Return an input of a codec's target; `models`: the records of its model. The third packet is lost."""
    kept = [packet if number != 2 else b"" for number, packet in enumerate(packets)]
    return b"".join(map(record, [bytes([channels - 1]) + configuration, *models, *kept]))


def decoded(golden: Sequence[Golden]) -> Iterator[tuple[str, bytes]]:
    """Yield the targets of codecs, each with inputs: its golden streams, other tables and windows, hostile models."""
    changes = bytes(map(operator.xor, mdct.built_in_tables(), mdct_tables.untrained_tables()))
    for name, header, packets, image in golden:
        payload = ModelImage.unpack(image).payload if image else b""
        ways = {
            "mdct": [[b"", b""], [changes, b""]],
            "eva": [[payload]],
        }
        for records in ways.get(name, [[]]):
            yield name, stream(header.configuration, packets, records, header.channels)
    generator = np.random.default_rng(1)
    for prior, steered in itertools.product(PRIOR_KINDS, (False, True)):
        noise = [pack_varint(2 * number + (number % 4 == 0)) + generator.bytes(30) for number in range(8)]
        yield "eva", stream(eva.configuration(3, [700], steered), noise, [random_image(2, 2, 3, prior).pack()], 1)
    for width in (2, 5):
        extreme = with_extreme_weights(random_image(3, width, 2), width).pack()
        yield "eva", stream(eva.configuration(3, [700, 30000]), noise, [extreme])


def headers(golden: Sequence[Golden]) -> list[bytes]:
    """Return a stream header of each unit, and those of golden streams."""
    made = [StreamHeader(1, RATE_HZ, None, unit, (1.0,), b"").pack() for unit in STREAM_UNITS]
    return sorted({*made, *(each.header.pack() for each in golden)})


def played(header: StreamHeader, packets: Sequence[bytes], image: bytes = b"") -> list[bytes]:
    """Return inputs of the decoder library: a file as it is, its parts, its link; and with too little of everything."""

    def setting(kind: int, polls: int = 0, memory: int = 0, packet: int = 5000, cut: int = 0) -> bytes:
        return record(little((kind, 1), (polls, 1), (memory, 2), (packet, 2), (cut, 2))) + record(image)

    file = pack_file(header, packets)
    # No number of a packet here takes more than its first byte.
    parts = record(header.pack()) + b"".join(record(bytes([packet[0] & 1]) + packet[1:]) for packet in packets)
    kept = [packet if number != 2 else b"" for number, packet in enumerate(packets)]
    link = record(header.pack()) + b"".join(map(record, kept))
    return [
        setting(0) + file,
        setting(1) + parts,
        setting(2) + link,
        setting(2, polls=2) + link,
        setting(0, cut=len(file) - 30) + file,
    ]


def files(golden: Sequence[Golden]) -> list[bytes]:
    """Return inputs of the decoder library: golden streams; of one packet, of no known length, with a model."""
    made = []
    for _, header, packets, image in golden:
        if not image:
            made += played(header, packets)
    made += [record(little((0, 1), (0, 1), (80, 2), (3, 2), (0, 2))) + record(b"") + pack_file(header, packets)]
    made += played(replace(header, samples=20), packets[:1])
    made += played(replace(header, samples=None), packets[:3])
    learned = next(each for each in golden if each.codec_name == "eva")
    return made + played(replace(learned.header, samples=None), learned.packets[:6], learned.image)


def little(*numbers: tuple[int, int]) -> bytes:
    """Return numbers, each with its count of bytes, little-endian; negative ones in two's complement."""
    return b"".join((number % 256**size).to_bytes(size, "little") for number, size in numbers)


def outputs() -> list[bytes]:
    """Return signals on their way to DACs: those of a texture and at every limit; gains, joints, Stops, restarts."""
    samples, wave, gain, join, ramp, restart = range(6)
    full, unity = 0x4280, np.float32(1).view(np.uint32).item()
    quiet = np.round(3000 * texture(300, 2)).astype("<i2").tobytes()
    loud = bytes([wave]) + little((2000, 2), (32767, 2), (32767, 2), (-32768, 2), (-32768, 2))
    gains = [bytes([gain]) + np.float32(factor).tobytes() for factor in (0, 0.5, 1, 100, 1e30)]
    doings = [
        bytes([samples]) + quiet,
        bytes([join]),
        bytes([samples]) + quiet,
        gains[1],
        loud,
        bytes([ramp]) + little((5, 2)),
        bytes([samples]) + quiet,
        bytes([ramp]) + little((65535, 2)),
        *gains,
        loud,
        bytes([restart]),
        loud,
    ]
    inputs = []
    for actuator, compensation, unit, rate_hz in itertools.product(range(4), (0, 128), (0, 1, 2), (800, 3000, 8000)):
        if (actuator + unit + rate_hz // 800 + compensation) % 3 == 0:
            setting = little((actuator + compensation, 1), (unit, 1), (1, 1), (rate_hz, 3), (full, 2), (full, 2))
            setting += little((unity, 4), (20, 2))
            inputs.append(b"".join(map(record, [setting, *doings])))
    lowest = bytes([wave]) + little((9999, 2), (-32768, 2))
    limits = ((400, 0, 0, 1, 1000), (400, 0, 0, 1, 53_020_244), (7000, 14, 30000, 65535, 2**29), (900, 8, 99, 9, 9))
    for rate_hz, bits, limit, step, power in limits:
        setting = little((4, 1), (0, 1), (0, 1), (2800, 3), (full, 2), (unity, 4), (20, 2))
        setting += little((rate_hz, 3), (bits, 1), (limit, 2), (step, 2), (power, 4), (128, 1))
        inputs.append(b"".join(map(record, [setting, lowest, *doings])))
    return inputs


def profiles() -> list[bytes]:
    """Return profiles under hands that move evenly, at random, backwards, and far too fast."""
    render, position, begin = range(3)
    heights = np.round(20_000 * texture(400)).astype("<i2").tobytes()
    generator = np.random.default_rng(1)
    inputs = []
    for channels, dac_rate_hz, pitch in ((1, 3000, 100_000), (2, 8000, 20_000), (4, 1000, 200_000)):
        setting = little((channels - 1, 1), (dac_rate_hz - 500, 2), (pitch, 3), (300, 2))
        for speed_mm_s in (50, -250, 900):
            parts = [bytes([begin])]
            for turn in range(12):
                place_nm = turn * 10_000 * speed_mm_s + int(generator.integers(-9, 9))
                parts += [bytes([position]) + little((turn * 10_000, 8), (place_nm, 8)), bytes([render, 30, 0])]
            jump = bytes([position]) + little((130_000, 8), (-(2**40), 8))
            inputs.append(b"".join(map(record, [setting, heights, *parts, jump, bytes([render, 200, 0])])))
    return inputs


def flashes() -> list[bytes]:
    """Return flashes, blank and with an image in each slot, and what is asked of them."""
    begin, write, verify, activate, confirm, erase, read, restart = range(8)
    second_slot = 8
    image = ModelImage(1, "small", "1", "", b"\xff\x00" * 50).pack()
    requests = [
        bytes([begin]) + image,
        bytes([write, 0, 0]) + image[:60],
        bytes([restart, 200]),
        bytes([begin]) + image,
        bytes([write, 0, 0]) + image,
        *(bytes([request]) for request in (verify, activate, restart, confirm)),
        bytes([second_slot + begin]) + image,
        bytes([second_slot + write, 0, 0]) + image,
        *(bytes([second_slot + request]) for request in (verify, activate)),
        bytes([restart, 1]),
        bytes([second_slot + read, 5, 0, 0, 0, 40, 0]),
        bytes([second_slot + erase]),
        bytes([restart, 255]),
    ]
    slot = len(image).to_bytes(4, "little") + sha256(image)
    inputs = [b"".join(map(record, [b"", b"", b"", b"", *requests]))]
    for states in (
        (SlotState.CONFIRMED, SlotState.TESTING),
        (SlotState.VERIFIED, SlotState.CONFIRMED),
        (SlotState.WRITING, SlotState.EMPTY),
    ):
        kept = b"VCSR\x05\0\0\0\0\0\0\0" + b"".join(bytes([state, 0]) + slot for state in states)
        inputs.append(b"".join(map(record, [kept, b"", image, image, *requests])))
    return inputs


def timed(*parts: Message | bytes | int) -> bytes:
    """Return an input of the target controller: requests and stream data, bytes of the wire, milliseconds that pass."""
    records = []
    for number, part in enumerate(parts):
        if isinstance(part, int):
            records.append(b"\x02" + part.to_bytes(2, "little"))
        elif isinstance(part, bytes):
            records.append(b"\x00" + part)
        else:
            records.append(b"\x01" + messages.pack(part, number + 1))
    return b"".join(map(record, records))


def controllers() -> list[bytes]:
    """Return what hosts do with a controller: play, read back, play live with losses, flash, follow a hand."""
    made = codec.encode(texture(1000, 2), RATE_HZ, {"step": 0.1}, live=True)
    header = StreamHeader(1, RATE_HZ, 1000, "um", (20.0, 10.0), made.header.configuration)
    all_packets = StreamData(7, 0, made.packets)
    recording = Configure(7, header.pack(), 280, len(made.packets), loops=2)
    live = Configure(7, StreamHeader(1, RATE_HZ, None, "m/s^2", header.gains, made.header.configuration).pack(), 100)
    some = [packet for number, packet in enumerate(made.packets) if number not in (1, 3, 4)]
    with_holes = StreamData(7, 0, tuple(some))
    surface = codec.encode(5 * texture(700, 2), 100_000, {"step": 0.1}, live=True)
    heights = StreamHeader(1, 100_000, 700, PROFILE_UNIT, surface.header.gains, surface.header.configuration)
    profile = Configure(9, heights.pack(), 0, len(surface.packets))
    hand: list[Message | int] = []
    for turn in range(10):
        hand += [Position(0, turn * 500_000), 10]
    loud: list[Message | int] = [Gain(1e6), 900, Gain(0.0), 30, Gain(1.0), 900, Stop(), 20]
    image = ModelImage(4, "oak", "1.0", "", random_image(1, 2, 2).pack()).pack()
    begin = FlashBegin(1, len(image), sha256(image), "board")
    pieces = [FlashData(1, offset, image[offset : offset + 400]) for offset in range(0, len(image), 400)]
    configuration = eva.configuration(5, [700])
    noise = StreamData(8, 0, tuple(pack_varint(2 * number + (number == 0)) + bytes(range(20)) for number in range(8)))
    learned = StreamHeader(4, RATE_HZ, 600, "full scale", (1.0,), configuration, sha256(image)[:4])
    flashing = [begin, *pieces, FlashVerify(1), FlashRead(1, 0, 99), FlashActivate(1), Hello(), FlashConfirm(1)]
    flashing.append(FlashErase(0))
    limited: list[Message | bytes | int] = [Hello(), recording, all_packets, Start(), *loud]
    limited += [recording, all_packets, Start(), 30, b"\x05noise\0" * 40, 1100]
    return [
        timed(Hello(), recording, all_packets, Start(), 200, Pause(), 20, Resume(), Gain(0.5), 100, Loop(1), 600),
        timed(
            Hello(), recording, all_packets, Start(), 1200, CaptureRead(Tap.DAC, 0, 900), CaptureRead(Tap.DECODED, 0, 9)
        ),
        timed(Hello(), CaptureRead(Tap.DAC, 0, 1), Pause(), Loop(2), EndStream(7, 1), FlashConfirm(0), FlashVerify(2)),
        timed(Hello(), live, with_holes, Start(50_000), 100, StatusRequest(), EndStream(7, 10), 300, Stop(), 50),
        timed(*limited),
        timed(Hello(), profile, StreamData(9, 0, surface.packets), Start(), 40, *hand, Pause(), 40, Resume(), *hand),
        timed(
            Hello(), *flashing, Configure(8, learned.pack(), 10, 8, loops=0), noise, Start(), 300, b"\x03garbage\0", 100
        ),
    ]


def main() -> None:
    """Write firmware/fuzz/corpus.zip."""
    golden = golden_streams()
    streams = list(decoded(golden))
    configure = Configure(7, golden[0].header.pack(), 280)
    from_host = [message for message, _ in test_messages.GOLDEN if message.TYPE < HelloResponse.TYPE]
    payloads = [messages.pack(message, 5) for message in (*from_host, configure)]
    wire = [write_frame(payload) for payload in payloads]
    tagged = payloads[0] + b"\xee\x02\x00ab"
    damaged_image = bytes([*IMAGE[:-4], *zlib.crc32(IMAGE).to_bytes(4, "little")])
    inputs = {
        **{name: [data for target, data in streams if target == name] for name in CODECS},
        "streams": files(golden),
        "frames": [b"\0" + b"".join(wire), b"".join(frame[:-3] + b"\0" for frame in wire), b"\x02" * 700 + wire[0]],
        "messages": [*payloads, tagged, b"\x3e\x34\x12", b""],
        "headers": headers(golden),
        "images": [
            IMAGE,
            damaged_image,
            with_signature(IMAGE, 3, bytes(64)),
            ModelImage(1, "é", "", "", mdct.built_in_tables()).pack(),
        ],
        "output": outputs(),
        "profile": profiles(),
        "flash": flashes(),
        "controller": controllers(),
    }
    assert tuple(inputs) == TARGETS
    with zipfile.ZipFile(CORPUS, "w", zipfile.ZIP_DEFLATED) as archive:
        for target, examples in inputs.items():
            for number, example in enumerate(examples):
                archive.writestr(zipfile.ZipInfo(f"{target}/{number:02}"), example, zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    main()
