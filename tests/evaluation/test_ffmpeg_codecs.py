"""Codecs of FFmpeg's libraries: delay, rates, edge inputs, their own programs."""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.codec.signals import RATE_HZ, edge_signals, texture
from vibrocast import codec
from vibrocast.codec import PEERS, CodecError, Setting, Signal, Stream
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


def encode(name: str, signal: Signal, setting: Setting | None = None) -> Stream:
    return codec.encode(signal, RATE_HZ, setting or {}, codec=name)


@every_setting
def test_decoded_signal_lags_by_the_stated_delay(name: str, setting: Setting) -> None:
    signal = texture(6000)
    stream = encode(name, signal, setting)
    decoded = stream.decode_integers()[:, 0]
    lags = range(200)
    fits = [float(np.dot(signal[:5000, 0], decoded[lag : lag + 5000])) for lag in lags]
    assert lags[int(np.argmax(fits))] == stream.delay_samples


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
        expected = np.clip(np.rint(signal / stream.header.gains[0] * 32_768), -32_768, 32_767)
        np.testing.assert_array_equal(stream.decode_integers()[:5000], expected)
    rounded = encode("wavpack", signal, {"bits_per_sample": 5}).decode_integers()
    assert not np.any(rounded % 2**11)
    assert len(np.unique(rounded)) > 16


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("signal_name", edge_signals())
def test_edge_inputs_are_decoded(name: str, signal_name: str) -> None:
    signal = edge_signals()[signal_name]
    decoded = encode(name, signal).decode()
    assert decoded.shape == signal.shape
    assert np.max(np.abs(decoded)) <= 2 * np.max(np.abs(signal)) + 1e-4  # where G.723.1 is never quite silent


def test_a_benchmark_measures_them_and_no_other_command_lists_them() -> None:
    assert list(measured_codecs())[-len(NAMES) :] == NAMES
    assert not set(NAMES) & set(codec.CODECS)
    script = "from vibrocast import codec; codec.codec_by_identifier(5)"
    told = subprocess.run([sys.executable, "-c", script], cwd=HERE.parents[1], capture_output=True, text=True)
    assert "the stream has the former codec opus, which only earlier versions play" in told.stderr


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
        stream.decoder()
    with pytest.raises(CodecError, match=r"needs av; install the extra \[peers\]: "):
        encode("g726", texture(100))


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
    for rate_point in PEERS[name].rate_points:
        stream = codec.encode(samples, rate_hz, rate_point, codec=name, unit="m/s^2")
        bits = 8 * stream.size_bytes / len(samples)
        reached_db = codec.snr_db(samples, stream.decode())
        assert reached_db == pytest.approx(np.interp(bits, theirs_bits, theirs_db), abs=2.0 if name == "flac" else 0.6)
