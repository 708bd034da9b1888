"""Frames: round trip, damage, resynchronisation, bounded memory."""

import itertools

import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.device_protocol.frames import DELIMITER, MAX_PAYLOAD_BYTES, FrameReader, write_frame
from vibrocast.errors import InputError

payloads = st.binary(min_size=1, max_size=600)


@given(st.lists(payloads), st.lists(st.integers(0, 2000)))
def test_payloads_come_back_however_the_bytes_are_cut(sent: list[bytes], cuts: list[int]) -> None:
    wire = b"".join(map(write_frame, sent))
    reader = FrameReader()
    received = []
    edges = [0, *sorted(min(cut, len(wire)) for cut in cuts), len(wire)]
    for start, end in itertools.pairwise(edges):
        received += reader.feed(wire[start:end])
    assert received == sent
    assert reader.bad_frames == 0


@pytest.mark.parametrize("payload", [b"", bytes(MAX_PAYLOAD_BYTES + 1)])
def test_payload_that_does_not_fit_is_rejected(payload: bytes) -> None:
    with pytest.raises(InputError, match="send less"):
        write_frame(payload)


@given(payloads, st.data())
def test_flipped_bits_of_a_byte_are_always_noticed(payload: bytes, data: st.DataObject) -> None:
    # A CRC-16 notices every burst of up to 16 bits.
    content = bytearray(cobs.decode(write_frame(payload)[:-1]))
    content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    reader = FrameReader()
    assert reader.feed(cobs.encode(bytes(content)) + DELIMITER) == []
    assert reader.bad_frames == 1


@given(st.binary(), payloads)
def test_in_step_again_after_garbage(garbage: bytes, payload: bytes) -> None:
    reader = FrameReader()
    assert reader.feed(garbage + DELIMITER + write_frame(payload))[-1] == payload


def test_memory_is_bounded_and_an_endless_frame_is_one_bad_frame() -> None:
    reader = FrameReader()
    for _ in range(100):
        assert reader.feed(b"\x01" * 10_000) == []
    assert len(reader._pending) < 2 * MAX_PAYLOAD_BYTES
    assert reader.feed(DELIMITER + write_frame(b"next")) == [b"next"]
    assert reader.bad_frames == 1
