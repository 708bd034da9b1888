"""Codecs of FFmpeg's libraries: delay, rates, edge inputs, what is rejected, stored streams, peers."""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.codec.signals import RATE_HZ, edge_signals, texture
from vibrocast import codec
from vibrocast.codec import PEERS, CodecError, CodedSignal, Setting, Signal
from vibrocast.codec.stream import as_stream, read_stream
from vibrocast.evaluation.peers import measured_codecs

HERE = Path(__file__).parent
SHARED = HERE.parents[1] / ".." / "shared"
CURVES = {"opus": "opus_celt@relabel", "amr-nb": "amr_nb@relabel", "g726": "g726@relabel", "flac": "flac"}

SETTINGS: list[tuple[str, Setting]] = [
    ("opus", {"bit_rate_bps": 24_000}),
    ("opus", {"bit_rate_bps": 32_000, "frame_samples": "20"}),
    ("opus", {"bit_rate_bps": 10_000, "frame_samples": "480"}),
    ("amr-nb", {"mode": 0}),
    ("amr-nb", {"mode": 7}),
    ("g723-1", {}),
    ("g726", {"bits_per_sample": 2}),
    ("g726", {"bits_per_sample": 5}),
    ("wavpack", {"bits_per_sample": 6}),
    ("wavpack", {"bits_per_sample": 16}),
    ("flac", {}),
]
every_setting = pytest.mark.parametrize(("name", "setting"), SETTINGS)
NAMES = list(dict(SETTINGS))


def encode(name: str, signal: Signal, setting: Setting | None = None) -> CodedSignal:
    return codec.encode(signal, RATE_HZ, setting or {}, codec=name)


def decoder_of(stream: CodedSignal, configuration: bytes | None = None) -> codec.Decoder:
    held = stream.configuration if configuration is None else configuration
    return codec.decoder(PEERS[stream.codec].identifier, held, stream.channels)


@every_setting
def test_decoded_signal_lags_by_the_stated_delay(name: str, setting: Setting) -> None:
    signal = texture(6000)
    stream = encode(name, signal, setting)
    decoded = codec.decode_integers(stream)[:, 0]
    lags = range(200)
    fits = [float(np.dot(signal[:5000, 0], decoded[lag : lag + 5000])) for lag in lags]
    assert lags[int(np.argmax(fits))] == decoder_of(stream).delay_samples


@pytest.mark.parametrize("samples", [1, 2800, 9000])
def test_constant_rates_are_kept_to_the_byte(samples: int) -> None:
    signal = texture(samples)
    for mode, frame_bytes in enumerate((13, 14, 16, 18, 20, 21, 27, 32)):
        payload = sum(len(packet) - 1 for packet in encode("amr-nb", signal, {"mode": mode}).packets)
        assert payload == -(-(samples + 40) // 160) * frame_bytes
    for bits in range(2, 6):
        payload = sum(len(packet) - 1 for packet in encode("g726", signal, {"bits_per_sample": bits}).packets)
        assert payload == -(-samples // 8) * bits
    assert sum(len(packet) - 1 for packet in encode("g723-1", signal).packets) == -(-(samples + 60) // 240) * 24


@pytest.mark.parametrize("bit_rate_bps", [8000, 16_000, 48_000])
def test_a_bit_rate_counts_at_the_label_of_8000_samples_per_second(bit_rate_bps: int) -> None:
    stream = encode("opus", texture(28_000), {"bit_rate_bps": bit_rate_bps})
    bits_per_sample = 8 * sum(map(len, stream.packets)) / 28_000
    assert bits_per_sample == pytest.approx(bit_rate_bps / 8000, rel=0.15)


def test_lossless_means_the_sixteen_bits_of_full_scale() -> None:
    signal = texture(5000)
    for name, setting in (("flac", {}), ("wavpack", {"bits_per_sample": 16})):
        stream = encode(name, signal, setting)
        expected = np.clip(np.rint(signal / stream.gains[0] * 32_768), -32_768, 32_767)
        np.testing.assert_array_equal(codec.decode_integers(stream)[:5000], expected)
    rounded = codec.decode_integers(encode("wavpack", signal, {"bits_per_sample": 5}))
    assert not np.any(rounded % 2**11)
    assert len(np.unique(rounded)) > 16


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("signal_name", edge_signals())
def test_edge_inputs_are_decoded(name: str, signal_name: str) -> None:
    signal = edge_signals()[signal_name]
    decoded = codec.decode(encode(name, signal))
    assert decoded.shape == signal.shape
    assert np.max(np.abs(decoded)) <= 2 * np.max(np.abs(signal)) + 1e-4  # where G.723.1 is never quite silent


def test_a_benchmark_measures_them_and_no_other_command_lists_them() -> None:
    assert list(measured_codecs())[-len(NAMES) :] == NAMES
    assert not set(NAMES) & set(codec.CODECS)
    script = "from vibrocast import codec; codec.codec_by_identifier(5)"
    told = subprocess.run([sys.executable, "-c", script], cwd=HERE.parents[1], capture_output=True, text=True)
    assert "the stream has the former codec opus, which only earlier versions play" in told.stderr


def test_packets_with_too_many_frames_or_uneven_ones_are_rejected() -> None:
    stream = codec.encode(texture(2000, 2), RATE_HZ, {}, codec="amr-nb", framing=codec.Framing(160, 0))
    head, frames = stream.packets[0][:1], stream.packets[0][1:]
    assert decoder_of(stream).decode(head + frames).shape == (160, 2)
    for damaged in (frames + frames, frames[:32], frames[:-1], frames + b"\0"):
        with pytest.raises(CodecError, match="damaged"):
            decoder_of(stream).decode(head + damaged)


def test_frames_of_another_length_or_format_are_rejected() -> None:
    import av

    stream = encode("flac", texture(2000))
    (longer,) = encode("flac", texture(800)).packets
    with pytest.raises(CodecError, match="damaged"):
        decoder_of(stream).decode(longer)
    context = av.CodecContext.create("flac", "w")
    assert isinstance(context, av.AudioCodecContext)
    context.sample_rate, context.layout, context.format = 8000, "mono", av.AudioFormat("s32")
    context.options = {"frame_size": "128"}
    frame = av.AudioFrame.from_ndarray(np.ones((1, 128), dtype=np.int32), format="s32", layout="mono")
    frame.sample_rate = 8000
    (deep,) = map(bytes, context.encode(frame))
    with pytest.raises(CodecError, match="sample format"):
        decoder_of(stream).decode(b"\x01" + bytes((len(deep),)) + deep)
    with pytest.raises(CodecError, match="empty frame"):
        decoder_of(stream).decode(b"\x01\x00")


@pytest.mark.parametrize(
    "configuration",
    [
        b"",
        b"\0\0\0",
        b"\0\0\1\0",
        b"\0\x08\0\4",
        b"\0\x08\1\4\0",
        b"\0\x08\1\6",
        b"\0\xff\xff\3\xff\x01\4",
        b"\x80" * 9,
    ],
)
def test_damaged_configurations_are_rejected(configuration: bytes) -> None:
    stream = encode("g726", texture(100))
    with pytest.raises(CodecError):
        decoder_of(stream, configuration)


@pytest.mark.parametrize("name", NAMES)
def test_damage_is_not_reported_in_addition_to_the_errors(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    """FFmpeg would write its own complaints to standard error."""
    stream = encode(name, texture(3000))
    generator = np.random.default_rng(4)
    decoder, rejected = decoder_of(stream), 0
    for packet in stream.packets:
        damaged = np.frombuffer(packet, dtype=np.uint8).copy()
        damaged[1:] ^= generator.integers(0, 256, len(damaged) - 1, dtype=np.uint8)
        try:
            decoder.decode(damaged.tobytes())
        except CodecError:
            rejected += 1
    assert rejected > 0 or name in ("g726", "g723-1")
    assert capfd.readouterr() == ("", "")


def test_limits_of_an_encoder() -> None:
    known = PEERS["g726"]
    for channels, packet_samples in ((0, 100), (17, 100), (1, 70_000), (1, 0)):
        signal_format = codec.SignalFormat(RATE_HZ, "um", (1.0,) * channels, (1.0,) * channels)
        with pytest.raises(CodecError):
            known.make_encoder(known.complete({}), signal_format, codec.Framing(packet_samples, 0), None, None)


def test_av_is_loaded_at_first_need_and_missed_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = "vibrocast.evaluation.cells, vibrocast.host.cli.entry"
    script = f"import sys, {imported}; sys.exit('av' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], cwd=HERE.parents[1], check=False).returncode == 0
    stream = encode("g726", texture(100))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(CodecError, match=r"needs av; install the extra \[peers\]: "):
        decoder_of(stream)
    with pytest.raises(CodecError, match=r"needs av; install the extra \[peers\]: "):
        encode("g726", texture(100))


GOLDEN_SNR_DB = {"opus": 12.01, "amr-nb": 2.16, "g723-1": 3.34, "g726": 15.96, "wavpack": 29.48, "flac": 90.06}


@pytest.mark.parametrize("name", NAMES)
def test_stored_streams_decode_to_what_they_did(name: str) -> None:
    """Within a tolerance: a decoder in floating point may change its last bits from build to build."""
    stream = read_stream(HERE / f"golden_{name}.vct")
    signal = texture(stream.samples, 2)
    assert stream.codec_name == name
    assert codec.snr_db(signal, stream.decode()) == pytest.approx(GOLDEN_SNR_DB[name], abs=0.05)


@pytest.mark.skipif(not SHARED.exists(), reason="the development recordings are not here")
@pytest.mark.parametrize("name", CURVES)
def test_figures_are_those_of_the_codecs_own_programs(name: str) -> None:
    """Measured elsewhere through each codec's own library or program: the same SNR at the same bits."""
    import soundfile

    trace = "textsense-text16"
    samples, rate_hz = soundfile.read(SHARED / "peers" / "dev_2800" / f"{trace}.wav", always_2d=True)
    with (SHARED / "peers" / "dev_2800.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if (row["trace"], row["codec"]) == (trace, CURVES[name])]
    theirs_bits = [float(row["bits_per_sample"]) for row in rows]
    theirs_db = [min(float(row["snr_db"]), 90.0) for row in rows]
    for rate_point in PEERS[name].rate_point_sets[name]:
        stream = as_stream(codec.encode(samples, rate_hz, rate_point, codec=name), "m/s^2")
        bits = 8 * stream.size_bytes / len(samples)
        reached_db = codec.snr_db(samples, stream.decode())
        assert reached_db == pytest.approx(np.interp(bits, theirs_bits, theirs_db), abs=2.0 if name == "flac" else 0.6)
