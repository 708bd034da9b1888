"""Frames in C against device_protocol/frames.py: the same payloads and the same count of bad ones, of any bytes."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.firmware.native import ffi, native, piece_bytes
from vibrocast.device_protocol.frames import MAX_PAYLOAD_BYTES, FrameReader, write_frame

payloads = st.binary(min_size=1, max_size=600)


class CFrameReader:
    """The reader in C, as FrameReader."""

    def __init__(self) -> None:
        self._memory = ffi.new("uint32_t[]", native.vc_frame_reader_size() // 4 + 1)
        self._reader = ffi.cast("vc_frame_reader *", self._memory)
        native.vc_frame_reader_init(self._reader)

    @property
    def bad_frames(self) -> int:
        return int(native.vc_frame_reader_bad_frames(self._reader))

    def feed(self, data: bytes) -> list[bytes]:
        received = []
        payload = ffi.new("vc_piece *")
        while data:
            taken = native.vc_frame_reader_feed(self._reader, data, len(data), payload)
            assert taken > 0
            data = data[taken:]
            if payload.length:
                received.append(piece_bytes(payload))
        return received


def c_frame(payload: bytes, capacity: int = 5000, pieces: int = 3) -> bytes:
    frame, writer = ffi.new("uint8_t[]", capacity), ffi.new("vc_frame_writer *")
    native.vc_frame_begin(writer, frame, capacity)
    edges = [len(payload) * piece // pieces for piece in range(pieces + 1)]
    for start, end in itertools.pairwise(edges):
        native.vc_frame_write(writer, payload[start:end], end - start)
    length = native.vc_frame_end(writer)
    return bytes(frame)[:length]


def with_byte(frame: bytes, at: int, value: int) -> bytes:
    return frame[:at] + bytes([value]) + frame[at + 1 :]


# Whole frames, frames with a damaged byte, cut frames, noise, zeros.
damaged = st.tuples(payloads.map(write_frame), st.floats(0, 1), st.integers(0, 255)).map(
    lambda drawn: with_byte(drawn[0], round(drawn[1] * (len(drawn[0]) - 1)), drawn[2])
)
wires = st.lists(
    st.one_of(
        payloads.map(write_frame),
        damaged,
        payloads.map(lambda payload: write_frame(payload)[:-3]),
        st.binary(max_size=20),
        st.just(b"\x01" * (MAX_PAYLOAD_BYTES + 50)),
        st.just(b"\0\0"),
    ),
    max_size=6,
)


@given(wires, st.lists(st.integers(0, 6000), max_size=5))
def test_reads_any_bytes_as_the_reader_in_python(pieces: list[bytes], cuts: list[int]) -> None:
    wire = b"".join(pieces)
    expected, reader = FrameReader(), CFrameReader()
    for start, end in itertools.pairwise([0, *sorted(min(cut, len(wire)) for cut in cuts), len(wire)]):
        assert reader.feed(wire[start:end]) == expected.feed(wire[start:end])
        assert reader.bad_frames == expected.bad_frames


@pytest.mark.parametrize("length", [*range(MAX_PAYLOAD_BYTES + 15, MAX_PAYLOAD_BYTES + 25)])
@pytest.mark.parametrize("code", [1, 2])
def test_longest_frames_and_too_long_ones_differ_as_in_python(length: int, code: int) -> None:
    expected, reader = FrameReader(), CFrameReader()
    wire = bytes([code] * length) + b"\0" + write_frame(b"next")
    assert reader.feed(wire) == expected.feed(wire) == [b"next"]
    assert reader.bad_frames == expected.bad_frames == 1


@given(payloads)
def test_writes_what_the_writer_in_python_writes(payload: bytes) -> None:
    assert c_frame(payload) == write_frame(payload)


@pytest.mark.parametrize("size", [1, 251, 252, 253, 254, 255, 1000, MAX_PAYLOAD_BYTES])
@pytest.mark.parametrize("byte", [b"\x00", b"\xff"])
def test_every_size_fits(size: int, byte: bytes) -> None:
    frame = write_frame(byte * size)
    assert c_frame(byte * size, len(frame)) == frame
    assert c_frame(byte * size, len(frame) - 1) == b""
    assert CFrameReader().feed(frame) == [byte * size]


@pytest.mark.parametrize("payload", [b"", bytes(MAX_PAYLOAD_BYTES + 1)])
def test_payload_that_does_not_fit_is_rejected(payload: bytes) -> None:
    assert c_frame(payload) == b""
