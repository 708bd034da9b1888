"""Tests of encoding recordings to streams, and decoding them again."""

import math
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vibrocast import models, textures
from vibrocast.codec import CodecError
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import image_hash, read_stream, write_recording
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader, pack_file
from vibrocast.device_protocol.encoding import pack_varint
from vibrocast.device_protocol.model_image import ModelError, ModelImage
from vibrocast.errors import InputError

MODEL = models.find("mdct-textures")


def noise(seconds: float = 0.5, channels: int = 1, rate_hz: float = 2800, unit: str = "m/s^2") -> textures.Recording:
    samples = np.random.default_rng(1).normal(size=(round(seconds * rate_hz), channels))
    return textures.Recording(samples, rate_hz, unit, "noise")


@pytest.mark.parametrize("snr_db", [6.0, 20.0, 40.0])
def test_meets_the_target_quality(snr_db: float) -> None:
    encoding = encode_recording(noise(), snr_db=snr_db)
    assert encoding.quality.snr_db == pytest.approx(snr_db, abs=0.2)
    assert encoding.quality.note is None


@pytest.mark.parametrize("rate_bps", [2000.0, 9000.0])
def test_meets_the_target_rate_in_bytes_of_the_file(rate_bps: float, tmp_path: Path) -> None:
    encoding = encode_recording(noise(seconds=2), rate_bps=rate_bps)
    encoding.stream.save(tmp_path / "noise.vct")
    assert 0.98 * rate_bps <= 8 * (tmp_path / "noise.vct").stat().st_size / 2 <= rate_bps


@pytest.mark.parametrize("codec_name", ["mdct", "slp", "dct"])
def test_packets_have_the_duration_that_you_choose(codec_name: str) -> None:
    encoding = encode_recording(noise(seconds=4), codec_name=codec_name, snr_db=12, packet_s=0.2)
    stream = encoding.stream
    packet_samples = stream.decoder().packet_samples
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


def test_says_why_a_target_cannot_be_met() -> None:
    with pytest.raises(CodecError, match="10 bit/s cannot be met"):
        encode_recording(noise(), rate_bps=10)
    with pytest.raises(CodecError, match="200 dB cannot be met"):
        encode_recording(noise(), snr_db=200)


def test_says_how_far_from_a_target_it_came() -> None:
    """Of a constant a few coefficients remain, and its quality jumps; above the finest step there is no more rate."""
    constant = textures.Recording(np.full((2800, 1), 0.5), 2800, "um", "constant")
    finer = encode_recording(constant, snr_db=15, touch=0)
    assert finer.quality.snr_db is not None
    assert finer.quality.snr_db > 15.2
    assert finer.quality.note is not None
    assert "instead of 15" in finer.quality.note
    finest = encode_recording(noise(), rate_bps=1e7)
    assert finest.quality.note is not None
    assert "instead of 10000000" in finest.quality.note


@settings(max_examples=20, deadline=None)
@given(samples=st.integers(1, 90), level=st.sampled_from([0.0, 1e-9, 1.0, 1e9]), channels=st.integers(1, 3))
def test_any_recording_can_be_coded_without_a_target(samples: int, level: float, channels: int) -> None:
    recording = textures.Recording(np.full((samples, channels), level), 2800, "um", "level")
    encoding = encode_recording(recording)
    assert encoding.stream.decode().shape == (samples, channels)
    if level:
        assert encoding.quality.snr_db is None or encoding.quality.snr_db > 14.5
    else:
        assert encoding.quality.snr_db is None


def test_a_file_holds_the_whole_stream(tmp_path: Path) -> None:
    encoding = encode_recording(noise(channels=2, rate_hz=10_000))
    path = tmp_path / "noise.vct"
    encoding.stream.save(path)
    stream = read_stream(path)
    assert stream == encoding.stream
    assert stream.size_bytes == path.stat().st_size
    facts = stream.facts()
    assert (facts["rate_hz"], facts["channels"], facts["unit"], facts["samples"]) == (2800, 2, "m/s^2", 1400)


def test_live_streams_refresh_and_files_do_not() -> None:
    assert encode_recording(noise(seconds=2)).stream.facts()["random_access_packets"] == 1
    assert encode_recording(noise(seconds=2), live=True).stream.facts()["random_access_packets"] >= 8


def test_damage_anywhere_is_found(tmp_path: Path) -> None:
    path = tmp_path / "noise.vct"
    encode_recording(noise(seconds=0.1)).stream.save(path)
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
    stream = encode_recording(noise(channels=2), live=True).stream
    assert len(stream.packets) * stream.decoder().packet_samples == 1504 + stream.decoder().delay_samples
    with pytest.raises(StreamError, match=flaw) if flaw else nullcontext():
        assert len(replace(stream, header=replace(stream.header, samples=samples)).decode()) == samples


def test_a_file_without_its_last_packet_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "noise.vct"
    stream = encode_recording(noise(), live=True).stream
    path.write_bytes(pack_file(stream.header, stream.packets[:-1]))
    with pytest.raises(StreamError, match=r"noise\.vct: it is cut short: 11 instead of 12"):
        read_stream(path)


@pytest.mark.parametrize("samples", [0, None])
def test_a_stream_without_signal_is_rejected(samples: int | None) -> None:
    stream = encode_recording(noise()).stream
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
    stream = encode_recording(noise()).stream
    monkeypatch.setattr("vibrocast.textures.memory.available_bytes", lambda: 1000)
    with pytest.raises(StreamError, match=r"decoding \d+ samples needs .* GiB of memory.*; cut it into parts"):
        stream.decode()


def test_a_live_header_leaves_the_length_to_the_packets() -> None:
    stream = encode_recording(noise(), live=True).stream
    live = replace(stream, header=replace(stream.header, samples=None))
    assert live.samples >= stream.samples
    np.testing.assert_array_equal(live.decode()[: stream.samples], stream.decode())


def test_float_wav_is_exact(tmp_path: Path) -> None:
    stream = encode_recording(noise(channels=2)).stream
    assert write_recording(tmp_path / "float.wav", stream) == 1.0
    exact = textures.load(tmp_path / "float.wav")
    np.testing.assert_array_equal(exact.samples, stream.decode())
    assert exact.unit == "m/s^2"


def test_an_error_names_the_wav_that_was_requested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, *_: object) -> NoReturn:
        raise textures.TextureError(f"{path}: cannot be written (System error); make room")

    stream = encode_recording(noise()).stream
    monkeypatch.setattr("vibrocast.textures.save", fail)
    with pytest.raises(textures.TextureError, match=r"/out\.wav: cannot be written .*; make room"):
        write_recording(tmp_path / "out.wav", stream)
    assert list(tmp_path.iterdir()) == []


def test_says_how_far_encoding_and_decoding_are() -> None:
    encoding, decoding = [0.0], [0.0]
    stream = encode_recording(noise(), progress=encoding.append).stream
    stream.decode(decoding.append)
    assert decoding == sorted(decoding)
    assert encoding[-1] <= 1 == decoding[-1]
    assert len(encoding) > 1


def test_names_the_channel_furthest_from_the_target_quality() -> None:
    samples = np.hstack([noise().samples, np.full((1400, 1), 0.5)])
    encoding = encode_recording(textures.Recording(samples, 2800, "um", "one constant channel"), snr_db=12, touch=0)
    misses_db = [abs(ratio - 12) for ratio in encoding.quality.snr_db_per_channel if ratio is not None]
    assert len(misses_db) == 2 and max(misses_db) > 0.2
    assert encoding.quality.note is not None
    assert f"instead of 12 in channel {1 + misses_db.index(max(misses_db))}" in encoding.quality.note


def test_an_image_is_named_by_the_stream_and_needed_to_decode(tmp_path: Path) -> None:
    recording = noise()
    own = replace(MODEL, image=ModelImage(1, "own", "1", "", MODEL.tables).pack())
    stream = encode_recording(recording, model=own).stream
    assert stream.header.image_hash == image_hash(own.image)
    stream.save(tmp_path / "noise.vct")
    assert read_stream(tmp_path / "noise.vct", own.image).decode().shape == recording.samples.shape
    unnamed = read_stream(tmp_path / "noise.vct")
    assert unnamed.facts()["model"] is None
    with pytest.raises(CodecError, match=f"{image_hash(own.image).hex()}, which does not ship"):
        unnamed.decode()
    with pytest.raises(CodecError, match="not coded for this model image"):
        read_stream(tmp_path / "noise.vct", MODEL.image)


def test_a_model_that_ships_is_found_by_the_streams_hash(tmp_path: Path) -> None:
    stream = encode_recording(noise(), model=MODEL).stream
    stream.save(tmp_path / "noise.vct")
    found = read_stream(tmp_path / "noise.vct")
    assert found.facts()["model"] == "mdct-textures"
    np.testing.assert_array_equal(found.decode(), stream.decode())


def test_a_model_that_does_not_fit_is_rejected() -> None:
    path = Path("other.vcmi")
    with pytest.raises(ModelError):
        encode_recording(noise(), model=models.Model("none", path, b"nonsense"))
    with pytest.raises(CodecError, match="codec number 99"):
        encode_recording(noise(), model=models.Model("other", path, ModelImage(99, "other", "1", "", b"").pack()))
    with pytest.raises(CodecError, match="not for the codec slp"):
        encode_recording(noise(), codec_name="slp", model=MODEL)
    with pytest.raises(CodecError, match="the tables have 9 bytes"):
        encode_recording(
            noise(), model=models.Model("short", path, ModelImage(1, "short", "1", "", b"too short").pack())
        )


@pytest.mark.parametrize("gain_db", [-1e9, -7000.0, -800.0, 800.0, 1e9, math.inf])
def test_a_level_beyond_any_stream_is_rejected(gain_db: float) -> None:
    recording = textures.Recording(np.random.default_rng(0).normal(size=(280, 1)), 2800, "m/s^2", "noise")
    stream = encode_recording(recording, setting={"step": 1.0}).stream
    with pytest.raises(CodecError, match=r"`gain_db`=.*give a number"):
        stream.with_gain(gain_db)
