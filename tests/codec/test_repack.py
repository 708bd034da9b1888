"""Streams in shorter packets: the same samples, refreshes where they were, and errors where no packet can be split."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.codec.signals import RATE_HZ, in_turn, played, texture
from tests.codec.test_mdct import TABLES, coded
from vibrocast import codec
from vibrocast.codec import CodecError, Framing, core, mdct
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import StreamError, packet_sequence
from vibrocast.textures import GENERATORS, Recording


def decoded(stream: tuple[bytes, list[bytes]], channels: int, tables: bytes) -> codec.Decoded:
    return played(mdct.MdctDecoder(stream[0], channels, tables), stream[1])


def refresh_samples(stream: tuple[bytes, list[bytes]], channels: int, tables: bytes) -> list[int]:
    """Return where the refreshes begin, in samples."""
    length = mdct.MdctDecoder(stream[0], channels, tables).packet_samples
    return [length * number for number, packet in enumerate(stream[1]) if packet_sequence(packet)[1]]


@given(
    hop=st.sampled_from(core.HOPS),
    channels=st.integers(1, 3),
    blocks=st.integers(1, 9),
    refresh_packets=st.sampled_from([0, 1, 3]),
    quantiser_offsets=st.lists(st.integers(-40, 40), max_size=4),
    step=st.sampled_from([0.01, 0.3, 2.0]),
    tables=st.sampled_from(list(TABLES.values())),
    packet_samples=st.integers(16, 1000),
)
@settings(max_examples=150, deadline=None)
def test_shorter_packets_decode_to_the_same_samples(
    hop: int,
    channels: int,
    blocks: int,
    refresh_packets: int,
    quantiser_offsets: list[int],
    step: float,
    tables: bytes,
    packet_samples: int,
) -> None:
    signal = np.concatenate([texture(400, channels), np.zeros((300, channels)), texture(500, channels, 2)])
    rate_control = in_turn(quantiser_offsets) if quantiser_offsets else None
    before = coded(signal, step, Framing(blocks * hop, refresh_packets), hop, tables, rate_control=rate_control)
    if packet_samples < hop:
        with pytest.raises(CodecError, match=f"no block of {hop}"):
            mdct.repack(before[0], channels, tables, before[1], packet_samples)
        return
    after = mdct.repack(before[0], channels, tables, before[1], packet_samples)
    assert mdct.MdctDecoder(after[0], channels, tables).packet_samples <= packet_samples
    assert [packet_sequence(packet)[0] for packet in after[1]] == list(range(len(after[1])))
    expected, samples = (decoded(each, channels, tables) for each in (before, after))
    np.testing.assert_array_equal(samples[: len(expected)], expected)
    assert refresh_samples(after, channels, tables) == refresh_samples(before, channels, tables)


def file_of(codec_name: str, rate_hz: int = 8000, **setting: str) -> Stream:
    """Return a texture of 2 s coded as a file."""
    return encode_recording(GENERATORS["rough"](seconds=2.0), rate_hz, codec_name, setting=setting).stream


def test_a_file_keeps_its_length_and_its_signal_but_for_noise() -> None:
    stream = file_of("mdct")
    short = stream.repacked(1000)
    assert short.packet_samples <= 1000 < stream.packet_samples
    assert (short.samples, short.image) == (stream.samples, stream.image)
    assert short.size_bytes < stream.size_bytes + 12 * len(short.packets)
    signal, difference = stream.decode(), short.decode() - stream.decode()
    # Coded at 14.8 dB: the noise is far below the error of coding.
    assert 0 < np.sum(difference**2) < 2e-3 * np.sum(signal**2)
    assert Stream.from_bytes(bytes(short)) == short


def test_packets_of_too_many_bytes_are_split() -> None:
    stream = encode_recording(GENERATORS["rough"](seconds=2.0), snr_db=50).stream
    assert max(map(len, stream.packets)) > 1000
    short = stream.repacked(4096, 1000)
    assert 500 < max(map(len, short.packets)) <= 1000


def test_a_stream_of_short_packets_stays_as_it_is() -> None:
    stream = file_of("mdct", 2800)
    assert stream.repacked(stream.packet_samples) is stream


def test_a_live_stream_of_unknown_length_is_split() -> None:
    recording = Recording(texture(2800), RATE_HZ, "full scale", "texture")
    stream = encode_recording(recording, RATE_HZ, live=True).stream
    stream = replace(stream, header=replace(stream.header, samples=None))
    short = stream.repacked(64)
    played, silence = np.split(short.decode(), [stream.samples])
    assert len(silence) < 128
    assert np.sum((played - stream.decode()) ** 2) < 1e-3 * np.sum(played**2)


@pytest.mark.parametrize(
    ("codec_name", "packet_samples", "packet_bytes", "flaw"),
    [
        ("slp", 2048, 4096, "packets of the codec slp cannot be split"),
        ("mdct", 15, 4096, "hold no block of"),
        ("mdct", 4096, 4, "hold no block of"),
    ],
)
def test_a_stream_that_cannot_be_split_so_far_is_rejected(
    codec_name: str, packet_samples: int, packet_bytes: int, flaw: str
) -> None:
    with pytest.raises(CodecError, match=flaw):
        file_of(codec_name).repacked(packet_samples, packet_bytes)


@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=4))
def test_hostile_packets_end_in_an_error_or_in_packets(packets: list[bytes]) -> None:
    configuration = mdct.configuration(32, 9, [500, 0], 3, rate_controlled=True)
    numbered = [bytes((2 * number + (number == 0),)) + packet for number, packet in enumerate(packets)]
    assert len(mdct.repack(configuration, 2, None, numbered, 100)[1]) == 3 * len(packets)
    with pytest.raises((CodecError, StreamError)):
        mdct.repack(configuration, 2, None, [packets[0][:0], *packets], 100)


def test_packets_out_of_order_are_rejected() -> None:
    configuration, packets = coded(texture(2000), 0.1, Framing(256, 3))
    with pytest.raises(CodecError, match="damaged"):
        mdct.repack(configuration, 1, None, [packets[0], packets[2]], 128)
