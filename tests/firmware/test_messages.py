"""Messages in C against device_protocol/messages.py: the same verdict on any bytes, the same values, the same bytes."""

import struct
from dataclasses import astuple
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.device_protocol.test_messages import MESSAGES, any_message, images, u8, u16
from tests.firmware.native import ffi, load, native, piece_bytes, refusal_text
from vibrocast.device_protocol import messages
from vibrocast.device_protocol.frames import FrameReader
from vibrocast.device_protocol.messages import (
    ActuatorDescription,
    CaptureData,
    CaptureRead,
    CodecDescription,
    Configure,
    EndStream,
    Error,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashData,
    FlashStatus,
    FlashVerify,
    Gain,
    Hello,
    HelloResponse,
    Loop,
    Message,
    MessageError,
    Pause,
    Position,
    Resume,
    SlotState,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
)

FROM_HOST = (*messages.REQUESTS, StreamData, Position)
EMPTY = (StatusRequest, Pause, Resume, Stop)


def float_of(bits: int) -> float:
    value: float = struct.unpack("<f", struct.pack("<I", bits))[0]
    return value


def float_bits(value: float) -> int:
    bits: int = struct.unpack("<I", struct.pack("<f", value))[0]
    return bits


def packets_of(packets: Any) -> tuple[bytes, ...]:
    packet, found = ffi.new("vc_piece *"), []
    left = ffi.new("vc_piece *", packets)
    while native.vc_next_packet(left, packet):
        found.append(piece_bytes(packet))
    return tuple(found)


def in_python(message: Any) -> Message:
    """Return what C has read as the message of Python."""
    body = message.body
    configure, begin, capture = body.configure, body.flash_begin, body.capture_read
    data, stream = body.flash_data, body.stream_data
    for empty in EMPTY:
        if message.type == empty.TYPE:
            return empty()
    match message.type:
        case Hello.TYPE:
            return Hello(body.hello.major, body.hello.minor)
        case Configure.TYPE:
            counts = (configure.prebuffer_samples, configure.packets, configure.first_packet, configure.loops)
            gain = float_of(configure.gain_float_bits)
            header = piece_bytes(configure.header)
            compensation = bool(configure.compensation)
            return Configure(configure.stream, header, *counts, gain, compensation=compensation)
        case Start.TYPE:
            return Start(body.start_us)
        case Loop.TYPE:
            return Loop(body.loops)
        case Gain.TYPE:
            return Gain(float_of(body.gain_float_bits))
        case EndStream.TYPE:
            return EndStream(body.end_stream.stream, body.end_stream.packets)
        case CaptureRead.TYPE:
            return CaptureRead(capture.tap, capture.offset, capture.count)
        case FlashBegin.TYPE:
            sha256 = bytes(ffi.buffer(begin.sha256, 32))
            return FlashBegin(begin.slot, begin.size_bytes, sha256, piece_bytes(begin.hardware).decode())
        case FlashData.TYPE:
            return FlashData(data.slot, data.offset, piece_bytes(data.data))
        case FlashVerify.TYPE:
            return FlashVerify(body.slot)
        case FlashActivate.TYPE:
            return FlashActivate(body.slot)
        case FlashConfirm.TYPE:
            return FlashConfirm(body.slot)
        case _:
            if message.type == Position.TYPE:
                return Position(body.position.time_us, body.position.position_nm)
            assert message.type == StreamData.TYPE
            return StreamData(stream.stream, stream.iteration, packets_of(stream.packets))


def check_read_as_in_python(payload: bytes) -> None:
    message, refusal = ffi.new("vc_message *"), ffi.new("vc_refusal *")
    memory = ffi.new("uint8_t[]", payload)  # of this very length, so that a sanitiser sees what is read beyond it
    code = native.vc_message_read(message, memory, len(payload), refusal)
    try:
        sequence, expected = messages.unpack(payload)
    except MessageError as error:
        assert (code, refusal.code, message.sequence) == (error.code, error.code, error.sequence)
        assert refusal_text(refusal)
    else:
        assert (code, message.sequence, in_python(message)) == (0, sequence, expected)


@pytest.mark.parametrize("message_type", FROM_HOST)
@given(data=st.data(), sequence=u16)
def test_reads_every_message_of_a_host(message_type: type[Message], data: st.DataObject, sequence: int) -> None:
    check_read_as_in_python(messages.pack(data.draw(MESSAGES[message_type]), sequence))


from_host = any_message.filter(lambda message: message.TYPE < HelloResponse.TYPE)


@given(from_host, st.data())
def test_reads_or_refuses_damaged_messages_as_python(message: Message, data: st.DataObject) -> None:
    payload = bytearray(messages.pack(message, 5))
    place = data.draw(st.integers(0, len(payload) - 1))
    check_read_as_in_python(bytes(payload[:place]))
    check_read_as_in_python(bytes(payload) + data.draw(st.binary(max_size=8)))
    payload[place] = data.draw(u8)
    if payload[0] < HelloResponse.TYPE:
        check_read_as_in_python(bytes(payload))


@given(st.integers(0, HelloResponse.TYPE - 1), st.binary(max_size=80))
def test_reads_or_refuses_any_bytes_as_python(message_type: int, body: bytes) -> None:
    check_read_as_in_python(bytes([message_type]) + body)


@given(st.sampled_from(FROM_HOST), st.binary(max_size=100))
def test_reads_or_refuses_any_body_as_python(message_type: type[Message], body: bytes) -> None:
    check_read_as_in_python(bytes([message_type.TYPE]) + body)


@given(st.lists(st.tuples(st.sampled_from([1, 1, 0, 7]), st.binary(max_size=12)), max_size=4))
def test_reads_tags_as_python(tags: list[tuple[int, bytes]]) -> None:
    rest = b"".join(struct.pack("<BH", tag, len(value)) + value for tag, value in tags)
    for fixed in (b"\x10\x05\x00" + bytes(37), b"\x03\x05\x00" + bytes(20), b"\x07\x05\x00"):
        check_read_as_in_python(fixed + rest)


@pytest.mark.parametrize("bits", [0, 1, 0x7F7FFFFF, 0x7F800000, 0x7FC00000, 0x80000000, 0x80000001, 0xFF800000])
def test_takes_the_gains_that_python_takes(bits: int) -> None:
    check_read_as_in_python(b"\x09\x05\x00" + struct.pack("<I", bits))
    check_read_as_in_python(b"\x03\x05\x00" + bytes(16) + struct.pack("<I", bits) + b"\x01\x00\x00")


def test_empty_message_is_refused() -> None:
    check_read_as_in_python(b"")


@given(st.one_of(st.text(), st.binary(max_size=6).map(lambda data: data.decode(errors="surrogateescape"))))
def test_texts_are_utf8_where_python_says_so(text: str) -> None:
    hardware = text.encode(errors="surrogateescape")
    check_read_as_in_python(b"\x10\x05\x00" + bytes(37) + struct.pack("<BH", 1, len(hardware)) + hardware)


class Writer:
    """A frame that C puts a message into."""

    def __init__(self) -> None:
        self._frame = ffi.new("uint8_t[]", 5000)
        self.pointer = ffi.new("vc_frame_writer *")
        native.vc_frame_begin(self.pointer, self._frame, 5000)

    def payload(self) -> bytes:
        length = native.vc_frame_end(self.pointer)
        (payload,) = FrameReader().feed(bytes(self._frame)[:length])
        return payload


@given(MESSAGES[Status], u16)
def test_status(status: Status, sequence: int) -> None:
    report = ffi.new(
        "vc_status_report *",
        {
            name: getattr(status, name)
            for name in ("state", "stream", "device_time_us", "position", "credit_until", "buffered_samples")
        }
        | {name: getattr(status, name) for name in ("bad_frames", "underruns", "lost_packets")},
    )
    for name in ("compensation_clipped", "voltage_limited", "slew_limited", "power_limited"):
        setattr(report.limited, name, getattr(status, name))
    writer = Writer()
    native.vc_put_status(writer.pointer, sequence, report)
    assert writer.payload() == messages.pack(status, sequence)


@given(MESSAGES[FlashStatus], u16, st.booleans())
def test_flash_status(status: FlashStatus, sequence: int, verified: bool) -> None:
    sha256 = ffi.new("uint8_t[]", status.sha256) if verified else ffi.NULL
    report = ffi.new("vc_flash_report *", [status.slot, status.state, status.next_offset, sha256])
    writer = Writer()
    native.vc_put_flash_status(writer.pointer, sequence, report)
    expected = FlashStatus(status.slot, status.state, status.next_offset, status.sha256 if verified else bytes(32))
    assert writer.payload() == messages.pack(expected, sequence)


@given(u16, u16, st.text(max_size=300))
def test_error_keeps_as_many_characters_as_fit(code: int, sequence: int, text: str) -> None:
    encoded = text.encode()
    memory = ffi.new("uint8_t[]", encoded)
    refusal, writer = ffi.new("vc_refusal *"), Writer()
    assert native.vc_refuse(refusal, 5, b"") == 5
    native.vc_refusal_add_piece(refusal, [memory, len(encoded)])
    refusal.code = code
    native.vc_put_error(writer.pointer, sequence, refusal)
    assert writer.payload() == messages.pack(Error(code, encoded[:200].decode(errors="ignore")), sequence)


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.binary(max_size=8))
def test_texts_of_refusals(first: int, second: int, data: bytes) -> None:
    refusal = ffi.new("vc_refusal *")
    native.vc_refuse_numbers(refusal, 9, b"# of #: ", first, second)
    assert native.vc_refusal_add_hex(refusal, data, len(data)) == 9
    assert refusal_text(refusal) == f"{first} of {second}: {data.hex()}"


@given(MESSAGES[CaptureData].filter(lambda message: isinstance(message, CaptureData)), u16, st.integers(0, 100))
def test_capture_data(capture: CaptureData, sequence: int, cut: int) -> None:
    samples = ffi.new("int16_t[]", list(struct.unpack(f"<{len(capture.data) // 2}h", capture.data)))
    cut = min(cut, len(samples))
    writer = Writer()
    native.vc_put_capture_data(writer.pointer, sequence, capture.tap, capture.channels, capture.offset, capture.end)
    native.vc_put_samples(writer.pointer, samples, cut)
    native.vc_put_samples(writer.pointer, samples + cut, len(samples) - cut)
    assert writer.payload() == messages.pack(capture, sequence)


short = st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=63)


@given(
    MESSAGES[HelloResponse],
    st.tuples(short, short, short),
    st.lists(st.tuples(u8, short), max_size=4),
    st.lists(images, min_size=2, max_size=2),
    u16,
)
def test_hello_response(
    response: HelloResponse,
    texts: tuple[str, str, str],
    codecs: list[tuple[int, str]],
    slots: list[messages.ImageDescription],
    sequence: int,
) -> None:
    kept: list[Any] = []

    def memory(text: str) -> Any:
        kept.append(ffi.new("char[]", text.encode()))
        return kept[-1]

    def piece(data: bytes) -> list[Any]:
        kept.append(ffi.new("uint8_t[]", data))
        return [kept[-1], len(data)]

    build, hardware, name = texts
    limits, actuator = response.limits, response.actuator
    floats = (actuator.stroke_um, actuator.volts, actuator.lower_hz, actuator.upper_hz, actuator.slew_volts_per_second)
    filled = ffi.new("vc_hello_response *")
    filled.build, filled.hardware = memory(build), memory(hardware)
    filled.limits = astuple(limits)
    filled.actuator = [memory(name), *map(float_bits, floats), actuator.dac_bits, actuator.dac_rate_hz]
    kept.append(ffi.new("vc_codec_description[]", [[number, memory(text)] for number, text in codecs]))
    filled.codecs, filled.codec_count = kept[-1], len(codecs)
    descriptions = [
        [slot.slot, slot.state, piece(slot.sha256)[0], piece(slot.name.encode()), piece(slot.version.encode())]
        for slot in slots
    ]
    kept.append(ffi.new("vc_image_description[]", descriptions))
    filled.images, filled.image_count = kept[-1], len(slots)
    writer = Writer()
    native.vc_put_hello_response(writer.pointer, sequence, filled)
    expected = HelloResponse(
        build, hardware, limits, ActuatorDescription(name, *floats, actuator.dac_bits, actuator.dac_rate_hz),
        tuple(CodecDescription(*codec) for codec in codecs), tuple(slots),
    )  # fmt: skip
    assert writer.payload() == messages.pack(expected, sequence)


def test_numbers_of_states_taps_and_slot_states_are_those_of_python() -> None:
    for prefix, enumeration in (("VC_STATE_", State), ("VC_TAP_", Tap), ("VC_SLOT_", SlotState)):
        for member in enumeration:
            assert getattr(native, prefix + member.name) == member
    for code in messages.ErrorCode:
        assert getattr(native, "VC_" + code.name) == code


def test_longest_hello_response_fits_the_smallest_payload() -> None:
    small_ffi, small = load(VC_MAXIMUM_PAYLOAD_BYTES=576)
    text, name = small_ffi.new("char[]", b"x" * 63), small_ffi.new("uint8_t[]", ("é" * 127).encode())
    sha256, frame = small_ffi.new("uint8_t[32]"), small_ffi.new("uint8_t[]", 600)
    codec_name = small_ffi.new("char[]", b"mdct")
    codecs = small_ffi.new("vc_codec_description[]", [[number, codec_name] for number in range(8)])
    slots = small_ffi.new(
        "vc_image_description[]", [[number, 4, sha256, [name, 254], [name, 254]] for number in range(2)]
    )
    response = small_ffi.new("vc_hello_response *", {"build": text, "hardware": text})
    response.actuator.name = text
    response.codecs, response.codec_count, response.images, response.image_count = codecs, 8, slots, 2
    writer = small_ffi.new("vc_frame_writer *")
    small.vc_frame_begin(writer, frame, 600)
    small.vc_put_hello_response(writer, 1, response)
    length = small.vc_frame_end(writer)
    (payload,) = FrameReader().feed(bytes(frame)[:length])
    _, read = messages.unpack(payload)
    assert isinstance(read, HelloResponse)
    assert (read.build, read.actuator.name, len(read.codecs)) == ("x" * 63, "x" * 63, 8)
    # Cut between characters, so that it stays a text.
    assert [image.name for image in read.images] == ["é" * 8] * 2
