"""Tests of encoding recordings to streams, and decoding them again."""

import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import noise, texture
from vibrocast import models, textures
from vibrocast.codec import CodecError
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import read_stream
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader, pack_file
from vibrocast.device_protocol.layout import pack_varint
from vibrocast.device_protocol.model_image import ModelError, ModelImage
from vibrocast.errors import InputError

MODEL = models.find("mdct-textures")
NOISE = texture(noise(0.5), "m/s^2")


@pytest.mark.parametrize("codec_name", ["mdct", "slp", "dct"])
def test_packets_have_the_duration_that_you_choose(codec_name: str) -> None:
    encoding = encode_recording(texture(noise(4), "m/s^2"), codec_name=codec_name, snr_db=12, packet_s=0.2)
    stream = encoding.stream
    packet_samples = stream.packet_samples
    assert 560 <= packet_samples < 560 + 512  # whole blocks
    refreshes = [packet[0] & 1 for packet in stream.packets]
    assert refreshes[0] and sum(refreshes) >= 2
    assert stream.samples == 4 * 2800
    assert encoding.quality.snr_db is not None and encoding.quality.snr_db > 11.8


def test_the_page_states_the_price_of_short_packets() -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "use_the_decoder.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| (none|\d+) \| ([\d ]+)\D.* \| (\d+) bytes \| .* \| (\d+) bytes \| (\d+) bytes \|$", page, re.M
    )
    assert len(rows) == 4
    oak = textures.load(Path(__file__).parents[2] / "examples" / "oak.wav")
    for packet_ms, samples, packet_bytes, *sizes in rows:
        packet_s = None if packet_ms == "none" else int(packet_ms) / 1000
        coded = [encode_recording(oak, codec_name=name, packet_s=packet_s).stream for name in ("mdct", "slp")]
        assert [stream.size_bytes for stream in coded] == [int(size) for size in sizes]
        facts = coded[0].facts()
        assert (facts["packet_samples"], facts["largest_packet_bytes"] + 2) == (
            int(samples.replace(" ", "")),
            int(packet_bytes),
        )


def test_says_how_far_from_a_target_it_came() -> None:
    """Of a constant a few coefficients remain, and its quality jumps; above the finest step there is no more rate."""
    constant = textures.Recording(np.full((2800, 1), 0.5), 2800, "um", "constant")
    finer = encode_recording(constant, snr_db=15, touch=0)
    assert finer.quality.snr_db is not None
    assert finer.quality.snr_db > 15.2
    assert finer.quality.note is not None
    assert "instead of 15" in finer.quality.note
    finest = encode_recording(NOISE, rate_bps=1e7)
    assert finest.quality.note is not None
    assert "instead of 10000000" in finest.quality.note


def test_live_streams_refresh_and_files_do_not() -> None:
    assert encode_recording(texture(noise(2), "m/s^2")).stream.facts()["random_access_packets"] == 1
    assert encode_recording(texture(noise(2), "m/s^2"), live=True).stream.facts()["random_access_packets"] >= 8


def test_damage_anywhere_is_found(tmp_path: Path) -> None:
    path = tmp_path / "noise.vct"
    encode_recording(texture(noise(0.1), "m/s^2")).stream.save(path)
    data = path.read_bytes()
    for position in range(len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        with pytest.raises((InputError, StreamError, CodecError)):
            read_stream(path).decode()


@pytest.mark.parametrize(
    ("samples", "flaw"),
    [(1, "surplus"), (1376, "surplus"), (1377, None), (1504, None), (1505, "cut short"), (2**62, "cut short")],
)
def test_more_or_fewer_packets_than_the_samples_take_are_rejected(samples: int, flaw: str | None) -> None:
    stream = encode_recording(texture(noise(0.5, 2), "m/s^2"), live=True).stream
    assert len(stream.packets) * stream.packet_samples == 1504 + stream.delay_samples
    with pytest.raises(StreamError, match=flaw) if flaw else nullcontext():
        assert len(replace(stream, header=replace(stream.header, samples=samples)).decode()) == samples


def test_a_file_without_its_last_packet_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "noise.vct"
    stream = encode_recording(NOISE, live=True).stream
    path.write_bytes(pack_file(stream.header, stream.packets[:-1]))
    with pytest.raises(StreamError, match=r"noise\.vct: it is cut short: 11 instead of 12"):
        read_stream(path)


@pytest.mark.parametrize("samples", [0, None])
def test_a_stream_without_signal_is_rejected(samples: int | None) -> None:
    stream = encode_recording(NOISE).stream
    header = replace(stream.header, samples=samples)
    with pytest.raises(StreamError, match="no signal"):
        replace(stream, header=header, packets=())
    if samples == 0:
        with pytest.raises(StreamError, match="no signal"):
            replace(stream, header=header)


@pytest.mark.parametrize("samples", [100, None])
def test_a_small_file_of_many_samples_is_rejected_before_it_is_decoded(samples: int | None, tmp_path: Path) -> None:
    path = tmp_path / "bomb.vct"
    longest_packets_of_16_channels = bytes((2047 << 3 & 0x7F | 0x82, 2047 << 3 >> 7)) + bytes(2 * 16)
    header = StreamHeader(1, 2800, samples, "um", (1.0,) * 16, longest_packets_of_16_channels)
    path.write_bytes(pack_file(header, [pack_varint(2 * n + (n == 0)) + b"\xff" for n in range(3000)]))
    assert path.stat().st_size < 20_000
    with pytest.raises(StreamError, match="surplus packets" if samples else "cut the recording into parts"):
        read_stream(path)


def test_a_stream_that_does_not_fit_into_memory_is_rejected_undecoded(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = encode_recording(NOISE).stream
    monkeypatch.setattr("vibrocast.memory.available_bytes", lambda: 1000)
    with pytest.raises(StreamError, match=r"decoding \d+ samples needs .* GiB of memory.*, or cut it into parts"):
        stream.decode()


def test_says_how_far_encoding_and_decoding_are() -> None:
    encoding, decoding = [0.0], [0.0]
    stream = encode_recording(NOISE, progress=encoding.append).stream
    stream.decode(decoding.append)
    assert decoding == sorted(decoding)
    assert encoding[-1] <= 1 == decoding[-1]
    assert len(encoding) > 1


def test_names_the_channel_furthest_from_the_target_quality() -> None:
    samples = np.hstack([NOISE.samples, np.full((1400, 1), 0.5)])
    encoding = encode_recording(textures.Recording(samples, 2800, "um", "one constant channel"), snr_db=12, touch=0)
    misses_db = [abs(ratio - 12) for ratio in encoding.quality.snr_db_per_channel if ratio is not None]
    assert len(misses_db) == 2 and max(misses_db) > 0.2
    assert encoding.quality.note is not None
    assert f"instead of 12 in channel {1 + misses_db.index(max(misses_db))}" in encoding.quality.note


@pytest.mark.parametrize(
    ("image", "codec_name", "flaw"),
    [
        (b"nonsense", None, "not a model image"),
        (ModelImage(99, "other", "1", "", b"").pack(), None, "codec number 99"),
        (MODEL.image, "slp", "not for the codec slp"),
        (ModelImage(1, "short", "1", "", b"too short").pack(), None, "the tables have 9 bytes"),
    ],
)
def test_a_model_that_does_not_fit_is_rejected(image: bytes, codec_name: str | None, flaw: str) -> None:
    with pytest.raises((CodecError, ModelError), match=flaw):
        encode_recording(NOISE, codec_name=codec_name, model=models.Model("other", Path("other.vcmi"), image))
