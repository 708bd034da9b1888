"""Frames: found in any noise and in any pieces; damaged ones are dropped, counted and never acted on."""

import random

import pytest
from cobs import cobs

from vibrocast.device_protocol.frames import DELIMITER, MAX_PAYLOAD_BYTES, write_frame
from vibrocast.device_protocol.layout import crc16
from vibrocast.device_protocol.messages import HelloResponse, State, Status, StatusRequest, Stop, StreamData, pack
from vibrocast.harness.conformance.fixtures import section
from vibrocast.harness.conformance.probe import Probe, describe, in_state
from vibrocast.harness.conformance.streams import stream_for

# docs/reference/protocol.md, "An example": Hello under number 0x1234.
_EXAMPLE = bytes.fromhex("05 01 34 12 02 03 24 16 00")
_EXAMPLE_NUMBER = 0x1234
_UNKNOWN_TAG = 0xEE
_TLV_BYTES = 3


def frame(payload: bytes, crc: int | None = None) -> bytes:
    """Return a frame of any payload, with another CRC than its own if one is given."""
    checked = crc16(payload) if crc is None else crc
    encoded: bytes = cobs.encode(payload + checked.to_bytes(2, "little"))
    return encoded + DELIMITER


def next_stop(probe: Probe) -> bytes:
    """Return the payload of a Stop that would be carried out."""
    return pack(Stop(), probe.sequence % 0xFFFF + 1)


def dropped(probe: Probe, data: bytes, bad_frames: int, what: str) -> None:
    """Send bytes that must be dropped and counted as `bad_frames`, then a frame that must be read."""
    before = probe.status()
    probe.link.write(data)
    after = probe.status()
    counted = (after.bad_frames - before.bad_frames) % (1 << 32)
    assert counted == bad_frames, f"{what}: expected {bad_frames} more bad frame(s), came {counted}"
    assert after.state == before.state, f"{what}: expected the state {before.state.name}, came {describe(after)}"


@section("Frames")
def test_published_example_is_read(probe: Probe) -> None:
    """The controller answers the example frame of Hello on the protocol's page."""
    while probe.opened_by == _EXAMPLE_NUMBER:
        probe.open()
    probe.link.write(_EXAMPLE)
    answer = probe.answer(_EXAMPLE_NUMBER)
    assert isinstance(answer, HelloResponse), f"expected HelloResponse, came {describe(answer)}"


@section("Frames")
def test_frame_is_found_after_noise(probe: Probe) -> None:
    """The controller reads a frame behind any noise that ends with a zero byte."""
    noise = random.Random(1)
    for length in (1, 2, 7, 100, 5000):
        probe.link.write(noise.randbytes(length) + DELIMITER)
        probe.status()


@section("Frames")
def test_zeros_alone_are_no_fault(probe: Probe) -> None:
    """The controller counts no bad frame for consecutive zero bytes."""
    dropped(probe, bytes(20), 0, "20 zero bytes")


@section("Frames")
def test_frame_with_a_wrong_crc_is_dropped(probe: Probe) -> None:
    """The controller drops and counts a frame with one wrong bit in the CRC, and does not act on it."""
    probe.configure(stream_for(probe.description))
    payload = next_stop(probe)
    damaged = b"".join(frame(payload, crc16(payload) ^ 1 << bit) for bit in range(16))
    dropped(probe, damaged, 16, "16 frames with one wrong bit in the CRC")


@section("Frames")
def test_frame_with_a_damaged_byte_is_dropped(probe: Probe) -> None:
    """The controller does not act on a frame with one damaged byte, and reads the next frame."""
    probe.configure(stream_for(probe.description))
    intact = write_frame(next_stop(probe))
    for position in range(len(intact) - 1):
        damaged = bytearray(intact)
        damaged[position] ^= 0x10 if damaged[position] != 0x10 else 0x20
        probe.link.write(bytes(damaged))
        in_state(probe.status(), State.BUFFERING, f"after a Stop whose byte {position} is damaged")


@section("Frames")
@pytest.mark.parametrize(
    ("fault", "data"),
    [
        ("without any content", b"\x01\x00"),
        ("with nothing but a CRC", frame(b"")),
        ("of one byte", b"\x02\x07\x00"),
        ("whose COBS code points beyond it", b"\x09\x07\x01\x00"),
    ],
    ids=["empty", "crc", "byte", "cobs"],
)
def test_frame_without_a_payload_is_dropped(probe: Probe, fault: str, data: bytes) -> None:
    """The controller drops and counts a frame {fault}."""
    dropped(probe, data, 1, f"a frame {fault}")


@section("Frames")
def test_frame_of_the_largest_size_is_read(probe: Probe) -> None:
    """The controller reads a payload of max_payload_bytes, whatever its bytes."""
    limit = probe.description.limits.max_payload_bytes
    room = limit - len(pack(StatusRequest(), 1)) - _TLV_BYTES
    for filler in (bytes(room), b"\xff" * room, random.Random(2).randbytes(room)):
        answer = probe.ask_body(StatusRequest.TYPE, bytes([_UNKNOWN_TAG]) + room.to_bytes(2, "little") + filler)
        assert isinstance(answer, Status), f"a payload of {limit} bytes: expected Status, came {describe(answer)}"


@section("Frames")
@pytest.mark.parametrize("surplus", [1, 2, 1000, 20_000])
def test_frame_that_is_too_long_is_dropped(probe: Probe, surplus: int) -> None:
    """The controller drops a frame whose payload exceeds the limit, and counts it once (bytes too many: {surplus})."""
    limit = probe.description.limits.max_payload_bytes
    payload = next_stop(probe).ljust(limit + surplus, b"\x55")
    dropped(probe, frame(payload), 1, f"a payload of {len(payload)} bytes")


@section("Frames")
def test_frame_may_come_in_pieces(probe: Probe) -> None:
    """The controller reads a frame that arrives byte by byte, or cut in two at any place."""
    length = len(write_frame(pack(StatusRequest(), MAX_PAYLOAD_BYTES)))
    for cuts in [[cut] for cut in range(1, length)] + [list(range(1, length))]:
        number = probe.sequence % 0xFFFF + 1
        whole = write_frame(pack(StatusRequest(), number))
        for first, last in zip([0, *cuts], [*cuts, len(whole)], strict=True):
            probe.link.write(whole[first:last])
            probe.link.sleep(0.001)
        answer = probe.answer(number)
        assert isinstance(answer, Status), f"cut at {cuts}: expected Status, came {describe(answer)}"


@section("Frames")
def test_frames_may_come_back_to_back(probe: Probe) -> None:
    """The controller reads frames that arrive together one by one, in their order."""
    stream = stream_for(probe.description)
    number = probe.configure(stream).stream
    packets = stream.packets[: probe.status().credit_until // stream.packet_samples]
    data = b"".join(write_frame(pack(StreamData(number, 0, (packet,)))) for packet in packets)
    probe.link.write(data)
    status = probe.status()
    expected = len(packets) * stream.packet_samples
    assert status.buffered_samples == expected, f"expected {expected} samples buffered, came {describe(status)}"


@section("Frames")
def test_answers_keep_to_the_limit(probe: Probe) -> None:
    """The controller sends no payload longer than its limit, HelloResponse included."""
    probe.open()
    limit = probe.description.limits.max_payload_bytes
    assert len(probe.last_answer) <= limit, f"expected at most {limit} bytes, came {len(probe.last_answer)}"
