"""The codec `parametric`: its core against a decoder written from the documentation, what it keeps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.codec.parametric_reference_decoder import ParametricReferenceDecoder
from tests.codec.signals import RATE_HZ, difference, edge_signals, played, texture
from vibrocast import codec
from vibrocast.codec import CodecError, Framing, Setting, SignalFormat, TargetUnreachable, parametric
from vibrocast.codec.core import CoreDecoder
from vibrocast.textures.generate import grating, taps


def coded(signal: codec.Signal, framing: Framing, **given: float | str) -> tuple[bytes, list[bytes]]:
    setting: Setting = parametric.CODEC.complete(given)
    ones = (1.0,) * signal.shape[1]
    encoder = parametric.ParametricEncoder(setting, SignalFormat(RATE_HZ, "full scale", ones, ones), framing)
    return encoder.configuration, encoder.encode(signal) + encoder.finish()


def decoded(configuration: bytes, packets: list[bytes], channels: int) -> codec.Decoded:
    return played(CoreDecoder(parametric.NAME, configuration, channels), packets)


def difference_to_the_documented_decoder(configuration: bytes, packets: list[bytes], channels: int) -> float:
    reference = ParametricReferenceDecoder(configuration, channels)
    return difference(reference, packets, decoded(configuration, packets, channels))


def tone(samples: int = 8000, turn: float = 1 / 41, harmonics: int = 3) -> codec.Signal:
    phases = 2 * np.pi * turn * np.arange(samples)[:, None]
    signal: codec.Signal = 0.3 * np.sum([np.sin(i * phases) / i for i in range(1, harmonics + 1)], axis=0)
    return signal


@pytest.mark.parametrize(
    ("hop", "bands", "step_db"), [("16", "octave", "6"), ("64", "sixth octave", "3"), ("128", "half octave", "0.75")]
)
@pytest.mark.parametrize("ridged", [False, True])
def test_core_agrees_with_the_documented_decoder(hop: str, bands: str, step_db: str, ridged: bool) -> None:
    signal = np.hstack([texture(3000, 2), tone(3000) * (np.arange(3000) > 900)[:, None] if ridged else texture(3000)])
    configuration, packets = coded(signal, Framing(512, 3), hop=hop, bands=bands, step_db=step_db, frame="4")
    assert difference_to_the_documented_decoder(configuration, packets, 3) < 1


@pytest.mark.slow
@given(st.integers(0, 63), st.integers(0, 8), st.integers(0, 3), st.integers(0, 3), st.binary(max_size=120))
@settings(max_examples=60)
def test_core_agrees_with_the_documented_decoder_on_any_bytes(
    shape: int, harmonics: int, frame: int, interval: int, payload: bytes
) -> None:
    configuration = bytes((shape, harmonics | frame << 4, min(interval, frame), 2, 0))
    reference, decoder = ParametricReferenceDecoder(configuration, 2), CoreDecoder(parametric.NAME, configuration, 2)
    for head in (b"\x01", b"\x02", b"\x05"):
        exact, samples = reference.samples(head + payload), decoder.decode(head + payload)
        # Thousands of times beyond full scale the core limits what is within, and not its samples alone.
        assert np.mean(np.abs(exact - samples) > 2) < 0.05


@pytest.mark.parametrize("name", [name for name, signal in edge_signals().items() if len(signal) > 1000])
def test_loudness_is_kept(name: str) -> None:
    signal = edge_signals()[name]
    if name == "square of one sample":  # of half the sampling rate itself neither transform sees all
        return
    configuration, packets = coded(signal, Framing(512, 0), step_db="1.5")
    samples = decoded(configuration, packets, 1)[64 : 64 + len(signal)] / 32768
    assert np.sqrt(np.mean(samples**2)) == pytest.approx(np.sqrt(np.mean(signal**2)), rel=0.35)


def test_a_rate_point_set_takes_some_30_to_500_bits_a_second() -> None:
    signal = texture(14_000)
    rates = []
    for rate_point in parametric.CODEC.rate_points:
        stream = codec.encode(signal, RATE_HZ, rate_point, codec="parametric")
        rates.append(8 * sum(map(len, stream.packets)) * RATE_HZ / len(signal))
    assert rates == sorted(rates)
    assert 10 < rates[0] < 60
    assert 250 < rates[-1] < 600


def test_ridges_keep_their_pitch_and_levels_at_any_rate() -> None:
    """The spectrum of a sum of tones has its peaks where they were, a step of pitch and of level apart at most."""
    turn = 1 / 41
    stream = codec.encode(tone(turn=turn), RATE_HZ, {"step_db": "1.5"}, codec="parametric")
    spectra = [
        np.abs(np.fft.rfft(samples[2000:6096, 0] * np.hanning(4096))) for samples in (tone(turn=turn), stream.decode())
    ]
    for harmonic in (1, 2, 3):
        middle = harmonic * turn * 4096
        around = slice(round(0.97 * middle), round(1.03 * middle) + 1)
        peaks = [float(np.max(spectrum[around])) for spectrum in spectra]
        assert peaks[1] == pytest.approx(peaks[0], rel=0.2)
        assert np.argmax(spectra[1][around]) == pytest.approx(np.argmax(spectra[0][around]), abs=0.01 * middle + 1)


def test_ridges_are_found_in_a_grating_and_not_in_noise() -> None:
    found = parametric.turns_of(grating(seconds=1.0).samples.T[:, :1024], 8)
    assert found[0] * 2800 == pytest.approx(50.0, rel=0.02)
    noise = np.random.default_rng(4).standard_normal((40, 1024))
    harmonics = codec.encode(noise.reshape(-1, 1), RATE_HZ, {}, codec="parametric")
    none = codec.encode(noise.reshape(-1, 1), RATE_HZ, {"harmonics": 0}, codec="parametric")
    assert sum(map(len, harmonics.packets)) < 1.1 * sum(map(len, none.packets))


def test_taps_stay_where_they_are() -> None:
    """Most of the energy comes within a block of where it was."""
    signal = taps(seed=2, seconds=3.0, rate_hz=RATE_HZ).samples
    stream = codec.encode(signal, RATE_HZ, {"hop": "32", "interval": "1"}, codec="parametric")
    both: list[codec.Signal] = [signal, stream.decode()]
    envelopes = [np.convolve(np.square(samples[:, 0]), np.ones(64), "same") for samples in both]
    assert np.corrcoef(envelopes)[0, 1] > 0.8


def test_settings_that_do_not_fit_are_rejected() -> None:
    with pytest.raises(CodecError, match="interval=8 is longer than frame=4"):
        coded(texture(100), Framing(64, 0), frame="4", interval="8")
    for configuration in (
        bytes(5),
        b"\x40\0\0\1\0",
        b"\0\x79\0\1\0",
        b"\0\x10\2\1\0",
        b"\3\x60\0\xff\x0f",
        b"\0\0\0\1",
    ):
        with pytest.raises(CodecError, match="configuration"):
            CoreDecoder(parametric.NAME, configuration, 1)


def test_an_snr_is_out_of_reach() -> None:
    with pytest.raises(TargetUnreachable, match="keeps no waveform; ask for a rate"):
        codec.encode_to_snr(codec.Source.of(texture(2800), RATE_HZ, codec="parametric"), 1.0)
