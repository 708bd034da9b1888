"""Messages: round trip of every type, unknown tags, lengths and values that must be rejected, fuzz."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.messages import (
    ALL,
    ActuatorDescription,
    CaptureData,
    CaptureRead,
    CodecDescription,
    CodingDescription,
    Configure,
    EndStream,
    Error,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashContents,
    FlashData,
    FlashErase,
    FlashRead,
    FlashStatus,
    FlashVerify,
    Gain,
    Hello,
    HelloResponse,
    ImageDescription,
    Limits,
    Loop,
    Message,
    MessageError,
    Pause,
    Position,
    Queue,
    QueuedStream,
    Resume,
    SinglePacket,
    SlotState,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
    pack,
    unpack,
)

u8, u16, u32, u64 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32, 64))
f32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
gains = st.floats(0, 1e6, width=32)
texts = st.text(max_size=40)
sha256s = st.binary(min_size=32, max_size=32)
codings = st.builds(CodingDescription, u32, u32)
queued = st.builds(QueuedStream, u8, u64)
states, slot_states, taps = st.sampled_from(State), st.sampled_from(SlotState), st.sampled_from(Tap)

limits = st.builds(Limits, u16, u16, u32, u32, u8, u32, u32, u16, u32)
actuators = st.builds(ActuatorDescription, texts, f32, f32, f32, f32, f32, u8, u32)
images = st.builds(ImageDescription, u8, slot_states, sha256s, texts, texts, number=u32)
captures = st.integers(1, 4).flatmap(
    lambda channels: st.builds(
        CaptureData, taps, st.just(channels), u64, u64, st.binary(max_size=40).map(lambda data: data * 2 * channels)
    )
)

MESSAGES: dict[type[Message], st.SearchStrategy[Message]] = {
    Hello: st.builds(Hello, u8, u8),
    StatusRequest: st.just(StatusRequest()),
    **{
        kind: st.builds(kind, u8, st.binary(max_size=300), u32, u32, u32, u16, gains, compensation=st.booleans())
        for kind in (Configure, Queue)
    },
    Start: st.builds(Start, u64),
    Pause: st.just(Pause()),
    Resume: st.just(Resume()),
    Stop: st.just(Stop()),
    Loop: st.builds(Loop, u16),
    Gain: st.builds(Gain, gains),
    EndStream: st.builds(EndStream, u8, u32),
    CaptureRead: st.builds(CaptureRead, taps, u64, u16),
    FlashBegin: st.builds(FlashBegin, u8, u32, sha256s, texts),
    FlashData: st.builds(FlashData, u8, u32, st.binary()),
    FlashVerify: st.builds(FlashVerify, u8),
    FlashActivate: st.builds(FlashActivate, u8),
    FlashConfirm: st.builds(FlashConfirm, u8),
    FlashErase: st.builds(FlashErase, u8),
    FlashRead: st.builds(FlashRead, u8, u32, u16),
    SinglePacket: st.builds(SinglePacket, u8, st.binary(max_size=200)),
    StreamData: st.builds(StreamData, u8, u32, st.lists(st.binary(max_size=200)).map(tuple)),
    Position: st.builds(Position, u64, st.integers(-(1 << 63), (1 << 63) - 1)),
    HelloResponse: st.builds(
        HelloResponse,
        texts,
        texts,
        limits,
        actuators,
        st.lists(st.builds(CodecDescription, u8, texts)).map(tuple),
        st.lists(images, max_size=3).map(tuple),
        st.one_of(st.just(b""), st.binary(min_size=32, max_size=32)),
        major=u8,
        minor=u8,
    ),
    Status: st.builds(
        Status, states, u8, u64, u64, u64, *[u32] * 10, st.booleans(), st.none() | codings, st.none() | queued
    ),
    CaptureData: captures,
    FlashStatus: st.builds(FlashStatus, u8, slot_states, u32, sha256s),
    FlashContents: st.builds(FlashContents, u8, u32, u32, st.binary(max_size=200)),
    Error: st.builds(Error, u16, texts),
}
any_message = st.one_of(*MESSAGES.values())
# In these, the end of the message is data and not tags.
UNTAGGED = (FlashData, FlashContents, CaptureData, StreamData, SinglePacket)


def test_every_message_is_tested() -> None:
    assert set(MESSAGES) == set(ALL) == {type(message) for message, _ in GOLDEN}
    assert len({message.TYPE for message in ALL}) == len(ALL)


@pytest.mark.parametrize("message_type", ALL)
@given(data=st.data(), sequence=u16)
def test_round_trip(message_type: type[Message], data: st.DataObject, sequence: int) -> None:
    message = data.draw(MESSAGES[message_type])
    unsequenced = message_type in (StreamData, SinglePacket, Position)
    assert unpack(pack(message, sequence)) == (0 if unsequenced else sequence, message)


@given(any_message.filter(lambda message: not isinstance(message, UNTAGGED)), st.binary(max_size=30))
def test_unknown_tags_are_skipped(message: Message, value: bytes) -> None:
    payload = pack(message, 5) + struct.pack("<BH", 0xEE, len(value)) + value
    assert unpack(payload) == (0 if isinstance(message, Position) else 5, message)


@given(any_message, st.data())
def test_cut_messages_are_read_or_rejected(message: Message, data: st.DataObject) -> None:
    payload = pack(message, 5)
    cut = payload[: data.draw(st.integers(0, len(payload) - 1))]
    try:
        _, read = unpack(cut)
    except MessageError:
        return
    assert type(read) is type(message)
    assert len(pack(read)) <= len(payload)


@given(
    st.one_of(
        st.binary(),
        st.tuples(st.sampled_from(ALL), st.binary(max_size=150)).map(lambda pair: bytes([pair[0].TYPE]) + pair[1]),
    )
)
def test_fuzz_is_read_or_rejected(payload: bytes) -> None:
    try:
        sequence, message = unpack(payload)
    except MessageError as error:
        assert error.code in (ErrorCode.MALFORMED, ErrorCode.UNKNOWN_MESSAGE, ErrorCode.BAD_VALUE)
        return
    assert unpack(pack(message, sequence))[0] == sequence


@pytest.mark.parametrize(
    ("payload", "code", "reason"),
    [
        (b"", ErrorCode.MALFORMED, "empty"),
        (b"\x01", ErrorCode.MALFORMED, "at least 3"),
        (b"\x01\x01\x00\x01", ErrorCode.MALFORMED, "Hello: 1 bytes"),
        (b"\x3e\x34\x12", ErrorCode.UNKNOWN_MESSAGE, "0x3e is not known"),
        (b"\x09\x01\x00\x00\x00\xc0\x7f", ErrorCode.BAD_VALUE, "finite"),
        (b"\x09\x01\x00\x00\x00\x80\xbf", ErrorCode.BAD_VALUE, "at least 0"),
        (b"\x04\x01\x00" + bytes(8) + b"\x01\x05\x00ab", ErrorCode.MALFORMED, "field of 5 bytes, 2 are left"),
        (b"\x03\x01\x00" + bytes(20), ErrorCode.MALFORMED, "tag 1 is missing: stream header"),
        (b"\x03\x01\x00\x00\x80" + bytes(18), ErrorCode.BAD_VALUE, "flags 0x80"),
        (b"\x40\x01\x80\x80\x80\x80\x80\x01", ErrorCode.MALFORMED, "longer than 32 bits"),
        (b"\x40\x01\x00\x05abc", ErrorCode.MALFORMED, "item of 5 bytes, 3 are left"),
        (b"\x40", ErrorCode.MALFORMED, "StreamData: 0 bytes, at least 1"),
        (b"\x82\x01\x00\x00\x02" + bytes(16) + b"abc", ErrorCode.MALFORMED, "3 bytes are no int16"),
        (b"\x80\x01\x00\x01\x00", ErrorCode.MALFORMED, "tag 1 is missing"),
        (b"\xff\x01\x00\x04\x00\x01\x01\x00\xff", ErrorCode.MALFORMED, "UTF-8"),
        (b"\x0b\x05\x00" + struct.pack("<BQH", 7, 0, 1), ErrorCode.BAD_VALUE, "7 is no Tap"),
    ],
)
def test_bad_bytes_are_rejected_with_the_reason(payload: bytes, code: ErrorCode, reason: str) -> None:
    with pytest.raises(MessageError, match=reason) as caught:
        unpack(payload)
    assert caught.value.code == code


@pytest.mark.parametrize(
    "message",
    [
        Start(-1),
        Start(1 << 64),
        Loop(65536),
        Gain(1e39),
        StreamData(256, 0, ()),
        StreamData(0, 1 << 32, ()),
        Error(1, "x" * 70_000),
    ],
)
def test_values_out_of_range_are_not_packed(message: Message) -> None:
    with pytest.raises(MessageError):
        pack(message, 1)
    with pytest.raises(MessageError, match="65536"):
        pack(Stop(), 65536)


HELLO = HelloResponse(
    "b", "h", Limits(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11), ActuatorDescription("a", 1, 2, 3, 4, 5, 6, 7), ()
)
LIMITS = bytes.fromhex("0100 0200 03000000 04000000 05 06000000 07000000 0800 09000000 0a000000 0b000000")


def test_what_a_later_minor_version_adds_to_the_limits_is_skipped() -> None:
    tag = struct.pack("<BH", 3, len(LIMITS)) + LIMITS
    assert pack(HELLO).count(tag) == 1
    longer = LIMITS + b"xx"
    assert unpack(pack(HELLO).replace(tag, struct.pack("<BH", 3, len(longer)) + longer))[1] == HELLO


SHA256 = bytes(range(32))
GOLDEN: list[tuple[Message, str]] = [
    (Hello(1, 1), "0134120101"),
    (StatusRequest(), "023412"),
    (
        Configure(7, b"VCT\x11", 280, packets=40, first_packet=4, loops=3, compensation=False, gain=0.5),
        "033412070018010000280000000400000003000000003f01040056435411",
    ),
    (Configure(1, b"", 70_000), "033412010170110100000000000000000001000000803f010000"),
    (
        Queue(7, b"VCT\x11", 280, packets=40, first_packet=4, loops=3, compensation=False, gain=0.5),
        "0c3412070018010000280000000400000003000000003f01040056435411",
    ),
    (Start(1 << 40), "0434120000000000010000"),
    (Pause(), "053412"),
    (Resume(), "063412"),
    (Stop(), "073412"),
    (Loop(258), "0834120201"),
    (Gain(1.5), "0934120000c03f"),
    (EndStream(7, 100_000), "0a341207a0860100"),
    (CaptureRead(Tap.DAC, 1 << 33, 500), "0b3412010000000002000000f401"),
    (
        FlashBegin(1, 70_000, SHA256, "board é"),
        "1034120170110100000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f010800626f61726420c3a9",
    ),
    (FlashData(1, 4096, b"\x00data"), "11341201001000000064617461"),
    (FlashVerify(1), "12341201"),
    (FlashActivate(1), "13341201"),
    (FlashConfirm(1), "14341201"),
    (FlashErase(1), "15341201"),
    (FlashRead(1, 70_000, 300), "16341201701101002c01"),
    (
        StreamData(7, 300, (b"\x01\xaa", b"", bytes(130))),
        "4007ac020201aa008201000000000000000000000000000000000000000000000000000000000000000000000000"
        "00000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "00000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
        "0000",
    ),
    (SinglePacket(7, b"\x01\xaa"), "420701aa"),
    (Position(1 << 41, -1_234_567_890_123), "41000000000002000035fb048ee0feffff"),
    (
        HelloResponse(
            build="b1",
            hardware="hé",
            limits=Limits(4096, 4084, 32768, 524288, 8, 100, 96000, 400, 65536, 4096, 117_600),
            actuator=ActuatorDescription("lra", 80.5, 150, 0, 270.25, 1000, 16, 48000),
            codecs=(CodecDescription(1, "mdct"), CodecDescription(11, "parametric")),
            images=(
                ImageDescription(0, SlotState.CONFIRMED, SHA256, "oak", "1.0", number=258),
                ImageDescription(1, SlotState.EMPTY),
            ),
            public_key=SHA256,
            serial_number="3f\u00b7",
            major=1,
            minor=1,
        ),
        "8034120101010200623102030068c3a90323000010f40f0080000000000800086400000000770100900100000100"
        "0010000060cb0100041c000000a14200001643000000000020874300007a441080bb00006c7261050500016d6463"
        "74050b000b706172616d6574726963062d000004000102030405060708090a0b0c0d0e0f10111213141516171819"
        "1a1b1c1d1e1f02010000036f616b312e300627000100000000000000000000000000000000000000000000000000"
        "00000000000000000000000000072000000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d"
        "1e1f08040033"
        "66c2b7",
    ),
    (
        Status(State.WATCHDOG, 7, 1 << 40, 64, 6400, 320, 1, 2, 3, 4, 5, 6, 1 << 31, 7, 8, True),
        "81341207070000000000010000400000000000000000190000000000004001000001000000020000000300000004"
        "000000050000000600000000000080070000000800000001",
    ),
    (
        Status(State.BUFFERING, 7, 1, 0, 6400, 0, 0, 0, 0, 0, 0, 0, 0, coding=CodingDescription(320, 70_000)),
        "81341201070100000000000000000000000000000000190000000000000000000000000000000000000000000000"
        "0000000000000000000000000000000000000000000000000108004001000070110100",
    ),
    (
        Status(State.PLAYING, 7, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, queued=QueuedStream(8, 1280)),
        "81341203070100000000000000020000000000000003000000000000000400000005000000060000000700000008"
        "000000090000000a0000000b000000000000000000000000020900080005000000000000",
    ),
    (
        CaptureData(Tap.DECODED, 2, 5, 1 << 34, b"\x01\x02\x03\x04"),
        "82341200020500000000000000000000000400000001020304",
    ),
    (
        FlashStatus(1, SlotState.VERIFIED, 70_000, SHA256),
        "833412010270110100000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f",
    ),
    (FlashContents(1, 70_000, 4096, b"\x00data"), "84341201701101000010000000" + "64617461"),
    (Error(300, "say hello first"), "ff34122c01010f007361792068656c6c6f206669727374"),
]


@pytest.mark.parametrize(("message", "packed"), GOLDEN, ids=lambda value: type(value).__name__)
def test_bytes_stay_as_they_are(message: Message, packed: str) -> None:
    assert pack(message, 0x1234).hex() == packed
    assert unpack(bytes.fromhex(packed))[1] == message
