"""Messages: unreadable ones get an Error; the controller skips additions of later versions."""

import pytest

from vibrocast.device_protocol.messages import (
    REQUESTS,
    CaptureData,
    CaptureRead,
    Configure,
    EndStream,
    ErrorCode,
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
    Queue,
    Resume,
    SinglePacket,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
    pack,
)
from vibrocast.harness.conformance.fixtures import long, section
from vibrocast.harness.conformance.probe import NotConforming, Probe, Undecided, an_error, describe, in_state
from vibrocast.harness.conformance.streams import lasting_stream, need_since, stream_for

# docs/reference/protocol.md, "Status"
_DRIFT = 0.01
_LOOKS, _LOOK_S = 11, 0.15
_KNOWN = {request.TYPE for request in REQUESTS}
_REQUEST_TYPES = range(0x01, 0x40)
_STREAM_TYPES = range(0x40, 0x80)
_CONTROLLER_TYPES = range(0x80, 0x100)
_FLASHING = (FlashBegin, FlashData, FlashVerify, FlashActivate, FlashConfirm, FlashErase, FlashRead)
# A tag that no version has, with a value.
_UNKNOWN_TLV = b"\xee\x05\x00later"
_NO_SLOT = 0xFF


@section("Messages")
def test_unknown_requests_are_answered_so(probe: Probe) -> None:
    """The controller answers UNKNOWN_MESSAGE to every unknown request type, with the request's number."""
    for message_type in _REQUEST_TYPES:
        if message_type not in _KNOWN:
            for body in (b"", b"\x01\x02\x03"):
                answer = probe.ask_body(message_type, body)
                an_error(answer, ErrorCode.UNKNOWN_MESSAGE, f"type 0x{message_type:02x} with {len(body)} bytes")


@section("Messages")
def test_unknown_stream_data_is_answered_without_a_number(probe: Probe) -> None:
    """The controller answers UNKNOWN_MESSAGE to every unknown type of stream data, with the number 0."""
    for message_type in _STREAM_TYPES:
        if message_type not in (StreamData.TYPE, Position.TYPE, SinglePacket.TYPE):
            what = f"stream data of type 0x{message_type:02x}"
            probe.complaint(bytes([message_type, 1, 2, 3]), ErrorCode.UNKNOWN_MESSAGE, what)


@section("Messages")
def test_messages_of_controllers_are_ignored(probe: Probe) -> None:
    """The controller ignores every type from 0x80 on."""
    for message_type in _CONTROLLER_TYPES:
        probe.unanswered(bytes([message_type, 1, 0, 2, 3]), f"a message of type 0x{message_type:02x}")


@section("Messages")
@pytest.mark.parametrize(
    "request_type", [request for request in REQUESTS if request.FIXED.size], ids=lambda request: request.__name__
)
def test_cut_requests_are_malformed(probe: Probe, request_type: type[Message]) -> None:
    """The controller answers MALFORMED to {request_type} with a cut fixed part, and does not carry it out."""
    name = request_type.__name__
    for length in range(request_type.FIXED.size):
        an_error(probe.ask_body(request_type.TYPE, bytes(length)), ErrorCode.MALFORMED, f"{name} of {length} bytes")
    in_state(probe.status(), State.STOPPED, f"after cut {name} messages")


@section("Messages")
def test_payload_without_room_for_a_number_is_malformed(probe: Probe) -> None:
    """The controller answers MALFORMED, with the number 0, to a request that ends before its number does."""
    for payload in (b"\x07", b"\x07\x01", b"\x3f"):
        probe.complaint(payload, ErrorCode.MALFORMED, f"the payload {payload.hex(' ')}")


@section("Messages")
@pytest.mark.parametrize(
    "request_type", [request for request in REQUESTS if request is not FlashData], ids=lambda request: request.__name__
)
def test_lengths_of_tlvs_are_checked(probe: Probe, request_type: type[Message]) -> None:
    """The controller answers MALFORMED to {request_type} with a cut or overlong TLV, and does not carry it out."""
    before = probe.configure(stream_for(probe.description)).state
    body = request_for(request_type, probe).body()
    for tlv in (b"\xee", b"\xee\x00", b"\xee\x01\x00", b"\xee\xff\xff\x00", _UNKNOWN_TLV[:-1]):
        answer = probe.ask_body(request_type.TYPE, body + tlv)
        an_error(answer, ErrorCode.MALFORMED, f"{request_type.__name__} with the TLV {tlv.hex(' ')}")
    in_state(probe.status(), before, f"after malformed {request_type.__name__} messages")


@section("Messages")
@pytest.mark.parametrize(
    "request_type",
    [request for request in REQUESTS if request not in _FLASHING],
    ids=lambda request: request.__name__,
)
def test_unknown_tags_are_skipped(probe: Probe, request_type: type[Message]) -> None:
    """The controller skips an unknown tag in {request_type}, and carries it out."""
    stream = lasting_stream(probe, 3 if request_type in (Pause, Resume) else 0)
    number = probe.configure(stream, **({"packets": 0} if request_type is EndStream else {})).stream
    if request_type in (Pause, Resume):
        probe.feed(number, stream)
        probe.expect(Start(), Status)
        probe.wait_for_state(State.PLAYING)
    if request_type is Resume:
        probe.expect(Pause(), Status)
    answer = probe.ask_body(request_type.TYPE, request_for(request_type, probe).body() + _UNKNOWN_TLV)
    expected = {Hello: HelloResponse, CaptureRead: CaptureData}.get(request_type, Status)
    assert isinstance(answer, expected), f"expected {expected.__name__}, came {describe(answer)}"


@section("Messages")
def test_unknown_tags_may_come_before_known_ones(probe: Probe) -> None:
    """The controller accepts an unknown tag before the known ones."""
    fixed, tlvs = split(probe.configuration(stream_for(probe.description)))
    answer = probe.ask_body(Configure.TYPE, fixed + _UNKNOWN_TLV + tlvs)
    assert isinstance(answer, Status), f"Configure with an unknown tag first: expected Status, came {describe(answer)}"


@section("Messages")
def test_configure_needs_its_stream_header(probe: Probe) -> None:
    """The controller answers MALFORMED to a Configure without a stream header."""
    fixed, _ = split(probe.configuration(stream_for(probe.description)))
    for tlvs in (b"", _UNKNOWN_TLV):
        an_error(probe.ask_body(Configure.TYPE, fixed + tlvs), ErrorCode.MALFORMED, "Configure without a stream header")


@section("Messages")
def test_flash_begin_needs_its_hardware_id(probe: Probe) -> None:
    """The controller answers MALFORMED to a FlashBegin whose hardware id is absent or not UTF-8."""
    fixed, _ = split(FlashBegin(_NO_SLOT, 100, bytes(32), ""))
    for what, tlvs in (("without a hardware id", b""), ("with a hardware id of bytes ff fe", b"\x01\x02\x00\xff\xfe")):
        an_error(probe.ask_body(FlashBegin.TYPE, fixed + tlvs), ErrorCode.MALFORMED, f"FlashBegin {what}")


@section("Messages: From the host")
@pytest.mark.parametrize(
    ("fault", "body"),
    [
        ("without a body", b""),
        ("without an iteration", b"\x01"),
        ("with an iteration that is cut", b"\x01\x80"),
        ("with an iteration of more than 32 bits", b"\x01\xff\xff\xff\xff\x1f"),
        ("with a packet longer than the frame", b"\x01\x00\x05\x01\x02"),
        ("with a packet's length that is cut", b"\x01\x00\x01\x01\x80"),
        ("with a packet's length of more than 32 bits", b"\x01\x00\xff\xff\xff\xff\x7f"),
    ],
    ids=["body", "iteration", "cut-iteration", "long-iteration", "packet", "cut-length", "long-length"],
)
def test_malformed_stream_data(probe: Probe, fault: str, body: bytes) -> None:
    """The controller answers one Error MALFORMED, with the number 0, to StreamData {fault}."""
    probe.complaint(bytes([StreamData.TYPE]) + body, ErrorCode.MALFORMED, f"StreamData {fault}")


@section("Messages: From the host")
def test_malformed_single_packet(probe: Probe) -> None:
    """The controller answers one Error MALFORMED, with the number 0, to SinglePacket without a body."""
    probe.complaint(bytes([SinglePacket.TYPE]), ErrorCode.MALFORMED, "SinglePacket without a body")


@section("Messages: From the host")
def test_single_packet_that_can_be_read_is_not_answered(probe: Probe) -> None:
    """The controller never answers readable SinglePacket, also without a stream or with an empty packet."""
    for packet in (b"", b"\x01", b"\xff" * 12):
        probe.notified.clear()
        probe.unanswered(pack(SinglePacket(9, packet)), "SinglePacket")
        assert not probe.notified, f"expected nothing, came {describe(probe.notified[0])}"


@section("Messages: From the host")
def test_stream_data_that_can_be_read_is_not_answered(probe: Probe) -> None:
    """The controller never answers readable StreamData, also without a stream or without a packet."""
    for packets in ((), (b"\x01",), (b"", b"\xff" * 12)):
        probe.notified.clear()
        probe.unanswered(pack(StreamData(9, 0, packets)), "StreamData")
        assert not probe.notified, f"expected nothing, came {describe(probe.notified[0])}"


def split(message: Message) -> tuple[bytes, bytes]:
    """Return the fixed part of a message and its TLVs."""
    body = message.body()
    return body[: message.FIXED.size], body[message.FIXED.size :]


def request_for(request_type: type[Message], probe: Probe) -> Message:
    """Return a request of a type that would be carried out on the configured stream; no slot is ever changed by it."""
    need_since(probe.description, request_type)
    stream = probe.status().stream
    requests: tuple[Message, ...] = (
        Hello(),
        StatusRequest(),
        Configure(stream, stream_for(probe.description).header.pack(), 0, packets=1),
        Queue((stream + 1) % 256, stream_for(probe.description).header.pack(), 0, packets=1),
        Start(),
        Pause(),
        Resume(),
        Stop(),
        Loop(1),
        Gain(0.5),
        EndStream(stream, 1),
        CaptureRead(Tap.DECODED, 0, 1),
        FlashBegin(_NO_SLOT, 100, bytes(32), ""),
        FlashVerify(_NO_SLOT),
        FlashActivate(_NO_SLOT),
        FlashConfirm(_NO_SLOT),
        FlashErase(_NO_SLOT),
        FlashRead(_NO_SLOT, 0, 1),
    )
    return next(request for request in requests if type(request) is request_type)


@long
@section("Messages: From the controller")
def test_the_clock_keeps_time(probe: Probe) -> None:
    """The controller's device_time_us keeps time within 1 %."""
    looks: list[tuple[float, float, float]] = []
    for _ in range(_LOOKS):
        asked_s = probe.link.clock()
        device_s = probe.status().device_time_us / 1e6
        looks.append((asked_s, device_s, probe.link.clock()))
        probe.listen(_LOOK_S)

    def passed(first: int, last: int) -> tuple[float, float, float]:
        """Return the least time between two looks, what the controller's clock counted, and the most time."""
        (asked_s, begin_s, answered_s), (asked_last_s, end_s, answered_last_s) = looks[first], looks[last]
        return (1 - _DRIFT) * (asked_last_s - answered_s), end_s - begin_s, (1 + _DRIFT) * (answered_last_s - asked_s)

    least_s, passed_s, most_s = passed(0, -1)
    came = f"expected {least_s:.3f} to {most_s:.3f} s, came {passed_s:.3f} s"
    parts = [passed(number, number + 1) for number in range(_LOOKS - 1)]
    if not least_s <= passed_s <= most_s:
        if any(least_s <= passed_s <= most_s for least_s, passed_s, most_s in parts):
            raise Undecided(f"what runs the controller stood still now and then: {came}")
        probe.link.forget_lateness()  # its clock is wrong all the time
        raise NotConforming(came)
