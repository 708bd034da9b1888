"""Messages in C against device_protocol/messages.py: the same verdict on any bytes, the same values, the same bytes."""

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.device_protocol.test_messages import MESSAGES, any_message, u8, u16
from tests.firmware.native import ffi, load, native, piece_bytes, rejection_text
from vibrocast.device_protocol import messages
from vibrocast.device_protocol.frames import FrameReader
from vibrocast.device_protocol.layout import Fixed, WireField, wire_fields

STRUCTS = {
    messages.ActuatorDescription: "vc_actuator_description",
    messages.CaptureData: "vc_capture_data",
    messages.CodecDescription: "vc_codec_description",
    messages.CodingDescription: "vc_coding_description",
    messages.QueuedStream: "vc_queued_stream",
    messages.Error: "vc_error",
    messages.FlashContents: "vc_flash_contents",
    messages.FlashStatus: "vc_flash_status",
    messages.HelloResponse: "vc_hello_response",
    messages.ImageDescription: "vc_image_description",
    messages.Limits: "vc_controller_limits",
    messages.Status: "vc_status_report",
}


def snake(owner: type) -> str:
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in owner.__name__)[1:]


def is_float(field: WireField) -> bool:
    return isinstance(field.wire, Fixed) and field.wire.name == "f32"


def items_of(items: Any) -> tuple[bytes, ...]:
    item, found = ffi.new("vc_piece *"), []
    left = ffi.new("vc_piece *", items)
    while native.vc_next_item(left, item):
        found.append(piece_bytes(item))
    return tuple(found)


def field_in_python(field: WireField, struct_in_c: Any) -> Any:
    if is_float(field):
        return struct.unpack("<f", struct.pack("<I", getattr(struct_in_c, f"{field.name}_float_bits")))[0]
    value = getattr(struct_in_c, field.name)
    if field.is_tuple:
        return items_of(value)
    if field.type is bytes and isinstance(field.wire, Fixed):
        return bytes(ffi.buffer(value, 32))
    if field.type in (bytes, str):
        return piece_bytes(value) if field.type is bytes else piece_bytes(value).decode()
    return field.type(value)


def in_python(message: Any) -> messages.Message:
    """Return what C has read as the message of Python."""
    kind = messages.MESSAGES[message.type]
    values = {field.name: field_in_python(field, getattr(message.body, snake(kind))) for field in wire_fields(kind)}
    return kind(**values)


class InC:
    """Objects of Python as structs in C, with the memory that they point to."""

    def __init__(self) -> None:
        self._kept: list[Any] = []

    def memory(self, declaration: str, value: Any) -> Any:
        self._kept.append(ffi.new(declaration, value))
        return self._kept[-1]

    def members(self, value: Any) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for field in wire_fields(type(value)):
            item = getattr(value, field.name)
            if is_float(field):
                found[f"{field.name}_float_bits"] = struct.unpack("<I", struct.pack("<f", item))[0]
            elif field.is_tuple:
                found[field.name] = self.memory(f"{STRUCTS[field.item]}[]", [self.members(each) for each in item])
                found[f"{field.name[:-1]}_count"] = len(item)
            elif field.type is str:
                text = item.encode()
                found[field.name] = [self.memory("uint8_t[]", text), len(text)]
            elif field.type is bytes and isinstance(field.wire, Fixed):
                found[field.name] = self.memory("uint8_t[]", item)
            elif field.type is bytes and type(value) is not messages.CaptureData:
                found[field.name] = [self.memory("uint8_t[]", item), len(item)]
            elif field.is_optional:
                found[field.name] = ffi.NULL if item is None else self.struct(item)
            elif field.type in STRUCTS:
                found[field.name] = self.members(item)
            elif field.type is not bytes:  # the caller of C writes the samples of a capture
                found[field.name] = item
        return found

    def struct(self, value: Any) -> Any:
        return self.memory(f"{STRUCTS[type(value)]} *", self.members(value))


def check_read_as_in_python(payload: bytes) -> None:
    message, rejection = ffi.new("vc_message *"), ffi.new("vc_rejection *")
    memory = ffi.new("uint8_t[]", payload)  # of this very length, so that a sanitiser sees what is read beyond it
    code = native.vc_message_read(message, memory, len(payload), rejection)
    try:
        sequence, expected = messages.unpack(payload)
    except messages.MessageError as error:
        assert (code, rejection.code, message.sequence) == (error.code, error.code, error.sequence)
        assert rejection_text(rejection)
    else:
        assert (code, message.sequence, in_python(message)) == (0, sequence, expected)


@pytest.mark.parametrize("message_type", messages.FROM_HOST)
@given(data=st.data(), sequence=u16)
def test_reads_every_message_of_a_host(
    message_type: type[messages.Message], data: st.DataObject, sequence: int
) -> None:
    check_read_as_in_python(messages.pack(data.draw(MESSAGES[message_type]), sequence))


from_host = any_message.filter(lambda message: message.TYPE < messages.HelloResponse.TYPE)


@given(from_host, st.data())
def test_reads_or_rejects_damaged_messages_as_python(message: messages.Message, data: st.DataObject) -> None:
    payload = bytearray(messages.pack(message, 5))
    place = data.draw(st.integers(0, len(payload) - 1))
    check_read_as_in_python(bytes(payload[:place]))
    check_read_as_in_python(bytes(payload) + data.draw(st.binary(max_size=8)))
    payload[place] = data.draw(u8)
    if payload[0] < messages.HelloResponse.TYPE:
        check_read_as_in_python(bytes(payload))


any_type = st.sampled_from([each.TYPE for each in messages.FROM_HOST]) | st.integers(0, messages.HelloResponse.TYPE - 1)


@given(any_type, st.binary(max_size=100))
def test_reads_or_rejects_any_bytes_as_python(message_type: int, body: bytes) -> None:
    check_read_as_in_python(b"")
    check_read_as_in_python(bytes([message_type]) + body)


@given(st.lists(st.tuples(st.sampled_from([1, 1, 0, 7]), st.binary(max_size=12)), max_size=4))
def test_reads_tags_as_python(tags: list[tuple[int, bytes]]) -> None:
    rest = b"".join(struct.pack("<BH", tag, len(value)) + value for tag, value in tags)
    for fixed in (b"\x10\x05\x00" + bytes(37), b"\x03\x05\x00" + bytes(20), b"\x07\x05\x00"):
        check_read_as_in_python(fixed + rest)


@pytest.mark.parametrize("bits", [0, 1, 0x7F7FFFFF, 0x7F800000, 0x7FC00000, 0x80000000, 0x80000001, 0xFF800000])
def test_takes_the_gains_that_python_takes(bits: int) -> None:
    check_read_as_in_python(b"\x09\x05\x00" + struct.pack("<I", bits))
    check_read_as_in_python(b"\x03\x05\x00" + bytes(16) + struct.pack("<I", bits) + b"\x01\x00\x00")


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


@pytest.mark.parametrize("message_type", messages.RESPONSES)
@given(data=st.data(), sequence=u16)
def test_writes_every_message_of_a_controller(
    message_type: type[messages.Message], data: st.DataObject, sequence: int
) -> None:
    message = data.draw(MESSAGES[message_type])
    writer, memory = Writer(), InC()
    getattr(native, f"vc_write_{snake(message_type)}")(writer.pointer, sequence, memory.struct(message))
    if isinstance(message, messages.CaptureData):
        count = len(message.data) // 2
        samples = memory.memory("int16_t[]", list(struct.unpack(f"<{count}h", message.data)))
        cut = data.draw(st.integers(0, count))
        native.vc_frame_write_samples(writer.pointer, samples, cut)
        native.vc_frame_write_samples(writer.pointer, samples + cut, count - cut)
    assert writer.payload() == messages.pack(message, sequence)


def test_hash_that_is_not_there_is_written_as_zeros() -> None:
    writer = Writer()
    native.vc_write_flash_status(writer.pointer, 5, ffi.new("vc_flash_status *", [1, 2, 3, ffi.NULL]))
    assert writer.payload() == messages.pack(messages.FlashStatus(1, messages.SlotState.VERIFIED, 3), 5)


@given(u16, u16, st.text(max_size=300))
def test_error_keeps_as_many_characters_as_fit(code: int, sequence: int, text: str) -> None:
    encoded = text.encode()
    memory = ffi.new("uint8_t[]", encoded)
    rejection, writer = ffi.new("vc_rejection *"), Writer()
    assert native.vc_reject(rejection, 5, b"") == 5
    native.vc_rejection_add_piece(rejection, [memory, len(encoded)])
    rejection.code = code
    native.vc_write_rejection(writer.pointer, sequence, rejection)
    assert writer.payload() == messages.pack(messages.Error(code, encoded[:200].decode(errors="ignore")), sequence)


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.binary(max_size=8))
def test_texts_of_rejections(first: int, second: int, data: bytes) -> None:
    rejection = ffi.new("vc_rejection *")
    native.vc_reject_numbers(rejection, 9, b"# of #: ", first, second)
    assert native.vc_rejection_add_hex(rejection, data, len(data)) == 9
    assert rejection_text(rejection) == f"{first} of {second}: {data.hex()}"


def test_longest_hello_response_fits_the_smallest_payload() -> None:
    small_ffi, small = load(VC_MAX_PAYLOAD_BYTES=640)
    text, frame = small_ffi.new("uint8_t[]", b"x" * 63), small_ffi.new("uint8_t[]", 660)
    # VC_IMAGE_TEXT_BYTES of sizes.h.
    name = [text, (640 - 576) // 4]
    sha256 = small_ffi.new("uint8_t[32]")
    codecs = small_ffi.new("vc_codec_description[]", [[number, [text, len("mdct")]] for number in range(8)])
    slots = small_ffi.new("vc_image_description[]", [[number, 4, sha256, 1, name, name] for number in range(2)])
    response = small_ffi.new("vc_hello_response *", {"build": [text, 63], "hardware": [text, 63]})
    response.public_key, response.serial_number = [sha256, 32], [text, 31]
    response.actuator.name = [text, 63]
    response.codecs, response.codec_count, response.images, response.image_count = codecs, 8, slots, 2
    writer = small_ffi.new("vc_frame_writer *")
    small.vc_frame_begin(writer, frame, 660)
    small.vc_write_hello_response(writer, 1, response)
    length = small.vc_frame_end(writer)
    (payload,) = FrameReader().feed(bytes(frame)[:length])
    _, read = messages.unpack(payload)
    assert isinstance(read, messages.HelloResponse)
    assert (read.build, len(read.codecs), [image.name for image in read.images]) == ("x" * 63, 8, ["x" * 16] * 2)
