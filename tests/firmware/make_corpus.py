"""Writes the inputs that fuzzing of the firmware starts from: python -m tests.firmware.make_corpus"""

import itertools
import zipfile
import zlib

import numpy as np

from tests.codec.eva_models import random_image
from tests.codec.signals import RATE_HZ, texture
from tests.firmware.fuzzing import CORPUS, TARGETS
from vibrocast import codec
from vibrocast.codec import Choice, Framing, Setting, SignalFormat, eva, mdct
from vibrocast.codec.eva_image import PRIOR_KINDS
from vibrocast.device_protocol import messages
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.encoding import pack_varint
from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.messages import (
    CaptureRead,
    Configure,
    EndStream,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashData,
    FlashVerify,
    Gain,
    Hello,
    Loop,
    Message,
    Pause,
    Resume,
    SlotState,
    Start,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
)
from vibrocast.device_protocol.model_image import ModelImage, sha256

HEADER = StreamHeader(
    1, RATE_HZ, 700, "m/s^2", (2.5, 1.0), mdct.configuration(16, 4, [700, 700], 3), b"\x01\x02\x03\x04"
)
IMAGE = ModelImage(4, "oak", "1.0", "board", random_image(1, 2, 2).pack()).pack()
SETTINGS: tuple[tuple[str, Setting], ...] = (
    ("mdct", {"step": 0.05}),
    ("mdct", {"step": 0.05, "noise_filling": 0.1, "hop": "16"}),
    ("dct", {"levels": 14, "entropy": "huffman", "block": "64"}),
    ("dct", {"levels": 100, "entropy": "range", "quantiser": "log", "block": "64"}),
    ("slp", {"quality": 20}),
    ("parametric", {"hop": "16", "frame": "4"}),
)


def record(data: bytes) -> bytes:
    """Return a record of the targets streams, flash and controller."""
    return len(data).to_bytes(2, "little") + data


def host_messages() -> list[Message]:
    """Return one message of each type that a host sends, and a second where it has another shape."""
    return [
        Hello(),
        StatusRequest(),
        Configure(7, HEADER.pack(), 280, 40, 4, 0),
        Start(5_000_000),
        Pause(),
        Resume(),
        Stop(),
        Loop(3),
        Gain(0.5),
        EndStream(7, 30),
        CaptureRead(Tap.DAC, 100, 50),
        FlashBegin(1, len(IMAGE), sha256(IMAGE), "board é"),
        FlashData(1, 0, IMAGE[:200]),
        FlashVerify(1),
        FlashActivate(1),
        FlashConfirm(1),
        StreamData(7, 0, (b"\x01abc", b"\x02defg")),
        StreamData(7, 1 << 31, (b"\x01" * 200, b"")),
    ]


def rate_controlled(name: str, setting: Setting) -> bytes:
    """Return a short stream whose packets differ in their quality."""
    turn = itertools.cycle([0, 0, 16, -3, 50])
    signal_format = SignalFormat(RATE_HZ, "um", (1.0, 1.0), (0.2, 0.2))
    known = codec.codec_by_name(name)
    encoder = known.make_encoder(
        known.complete(setting), signal_format, Framing(64, 4), None, lambda trial: Choice(next(turn), 12)
    )
    packets = encoder.encode(texture(600, 2))
    header = StreamHeader(known.identifier, RATE_HZ, None, "um", signal_format.gains, encoder.configuration)
    return b"".join(map(record, [b"", header.pack(), *packets]))


def streams() -> list[bytes]:
    """Return a short stream of every codec, one packet of it missing, and rate-controlled ones."""
    inputs = []
    for name, setting in SETTINGS:
        coded = codec.encode(texture(300, 2), RATE_HZ, setting, codec=name, live=True)
        identifier = codec.codec_by_name(name).identifier
        header = StreamHeader(identifier, RATE_HZ, 300, "um", coded.gains, coded.configuration)
        packets = [packet if number != 2 else b"" for number, packet in enumerate(coded.packets)]
        inputs.append(b"".join(map(record, [b"", header.pack(), *packets])))
    inputs += [rate_controlled(name, setting) for name, setting in SETTINGS if codec.codec_by_name(name).controls_rate]
    generator = np.random.default_rng(1)
    for prior, is_rate_controlled in itertools.product(PRIOR_KINDS, (False, True)):
        configuration = eva.configuration(3, [700], is_rate_controlled)
        header = StreamHeader(4, RATE_HZ, None, "um", (1.0,), configuration, b"hash")
        noise = [pack_varint(2 * number + (number % 4 == 0)) + generator.bytes(30) for number in range(8)]
        model = random_image(2, 2, 3, prior).pack()
        inputs.append(b"".join(map(record, [model, header.pack(), *noise[:2], b"", *noise[3:]])))
    return inputs


def flashes() -> list[bytes]:
    """Return flashes, blank and with an image in each slot, and what is asked of them."""
    begin, write, verify, activate, confirm, restart = range(6)
    second_slot = 6
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
        bytes([restart, 255]),
    ]
    slot = len(image).to_bytes(4, "little") + sha256(image)
    inputs = [b"".join(map(record, [b"", b"", b"", b"", *requests]))]
    for states in (
        (SlotState.CONFIRMED, SlotState.TESTING),
        (SlotState.VERIFIED, SlotState.CONFIRMED),
        (SlotState.WRITING, SlotState.EMPTY),
    ):
        kept = b"VCFS\x05\0\0\0" + b"".join(bytes([state, 0]) + slot for state in states)
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
    """Return what hosts do with a controller: play a recording, read it back, play live with losses, flash an image."""
    coded = codec.encode(texture(1000, 2), RATE_HZ, {"step": 0.1}, live=True)
    header = StreamHeader(1, RATE_HZ, 1000, "um", (20.0, 10.0), coded.configuration)
    all_packets = StreamData(7, 0, coded.packets)
    recording = Configure(7, header.pack(), 280, len(coded.packets), loops=2)
    live = Configure(7, StreamHeader(1, RATE_HZ, None, "m/s^2", header.gains, coded.configuration).pack(), 100)
    with_holes = StreamData(
        7, 0, tuple(packet for number, packet in enumerate(coded.packets) if number not in (1, 3, 4))
    )
    image = ModelImage(4, "oak", "1.0", "", random_image(1, 2, 2).pack()).pack()
    begin = FlashBegin(1, len(image), sha256(image), "board")
    pieces = [FlashData(1, offset, image[offset : offset + 400]) for offset in range(0, len(image), 400)]
    configuration = eva.configuration(5, [700])
    noise = StreamData(8, 0, tuple(pack_varint(2 * number + (number == 0)) + bytes(range(20)) for number in range(8)))
    learned = StreamHeader(4, RATE_HZ, 600, "full scale", (1.0,), configuration, sha256(image)[:4])
    flashing = [begin, *pieces, FlashVerify(1), FlashActivate(1), Hello(), FlashConfirm(1)]
    return [
        timed(Hello(), recording, all_packets, Start(), 200, Pause(), 20, Resume(), Gain(0.5), 100, Loop(1), 600),
        timed(
            Hello(), recording, all_packets, Start(), 1200, CaptureRead(Tap.DAC, 0, 900), CaptureRead(Tap.DECODED, 0, 9)
        ),
        timed(Hello(), CaptureRead(Tap.DAC, 0, 1), Pause(), Loop(2), EndStream(7, 1), FlashConfirm(0), FlashVerify(2)),
        timed(Hello(), live, with_holes, Start(50_000), 100, StatusRequest(), EndStream(7, 10), 300, Stop(), 50),
        timed(
            Hello(), *flashing, Configure(8, learned.pack(), 10, 8, loops=0), noise, Start(), 300, b"\x03garbage\0", 100
        ),
    ]


def main() -> None:
    """Write firmware/fuzz/corpus.zip."""
    payloads = [messages.pack(message, number + 1) for number, message in enumerate(host_messages())]
    wire = [write_frame(payload) for payload in payloads]
    tagged = payloads[0] + b"\xee\x02\x00ab"
    damaged_image = bytes([*IMAGE[:-4], *zlib.crc32(IMAGE).to_bytes(4, "little")])
    inputs = {
        "frames": [b"\0" + b"".join(wire), b"".join(frame[:-3] + b"\0" for frame in wire), b"\x02" * 700 + wire[0]],
        "messages": [*payloads, tagged, b"\x3e\x34\x12", b""],
        "images": [IMAGE, damaged_image, ModelImage(1, "é", "", "", mdct.built_in_tables()).pack()],
        "streams": streams(),
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
