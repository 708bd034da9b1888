"""The codec `mdct`: its core against a decoder written from the documentation, shapes, tables, parameters."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.codec.reference_decoder import ReferenceDecoder
from tests.codec.signals import RATE_HZ, difference, edge_signals, in_turn, played, texture
from vibrocast import codec
from vibrocast.codec import Choice, CodecError, Framing, RateControl, mdct
from vibrocast.export import mdct_tables

TABLES = {"built in": mdct.built_in_tables(), "untrained": mdct_tables.untrained_tables()}


def coded(
    signal: codec.Signal,
    step: float,
    framing: Framing,
    hop: int | None = None,
    tables: bytes | None = None,
    noise_filling: float = 0.0,
    rate_control: RateControl | None = None,
    shape: Sequence[float] | None = None,
) -> tuple[bytes, list[bytes]]:
    steps = [step] * signal.shape[1]
    encoder = mdct.MdctEncoder(
        steps, RATE_HZ, framing, tables, hop=hop, noise_filling=noise_filling, rate_control=rate_control, shape=shape
    )
    packets = encoder.encode(signal) + encoder.finish()
    return encoder.configuration, packets


def decoded(configuration: bytes, packets: list[bytes], channels: int, tables: bytes | None = None) -> codec.Decoded:
    return played(mdct.MdctDecoder(configuration, channels, tables), packets)


def documented(
    configuration: bytes, packets: list[bytes], channels: int, tables: bytes | None = None
) -> NDArray[np.int64]:
    """The samples that docs/reference/bitstream.md leads to."""
    reference = ReferenceDecoder(configuration, channels, tables or mdct.built_in_tables())
    return np.concatenate([reference.integers(packet) for packet in packets])


@pytest.mark.parametrize("hop", mdct.HOPS)
@pytest.mark.parametrize(("channels", "noise_filling"), [(1, 0.0), (3, 1 / 32)])
@pytest.mark.parametrize("tables", TABLES.values(), ids=TABLES)
def test_core_agrees_with_the_documented_decoder(hop: int, channels: int, noise_filling: float, tables: bytes) -> None:
    """Samples equal to the last bit, and less than 1/8 of it from the exact transform, besides their rounding."""
    signal = np.concatenate([texture(800, channels), np.zeros((300, channels)), texture(400, channels)])
    configuration, packets = coded(signal, 0.05, Framing(4 * hop, 5), hop, tables, noise_filling)
    played = decoded(configuration, packets, channels, tables)
    np.testing.assert_array_equal(documented(configuration, packets, channels, tables), played)
    reference = ReferenceDecoder(configuration, channels, tables)
    assert difference(reference, packets, played) < 1 / 2 + 1 / 8


@pytest.mark.parametrize("name", ["impulses", "full-scale square", "four-bit", "sweep"])
def test_core_agrees_with_the_documented_decoder_at_fine_steps(name: str) -> None:
    signal = edge_signals()[name][:700]
    configuration, packets = coded(signal, 2.0**-14, Framing(256, 0))
    np.testing.assert_array_equal(documented(configuration, packets, 1), decoded(configuration, packets, 1))


@pytest.mark.parametrize("hop", mdct.HOPS)
def test_core_agrees_with_the_documented_decoder_beyond_full_scale(hop: int) -> None:
    """Coefficients that only a hostile stream has, which the transform shifts down."""
    encoder = mdct.MdctEncoder([2.0**-3], RATE_HZ, Framing(2 * hop, 0), hop=hop)
    signs = np.random.default_rng(hop).choice([-1, 1], (4, 1, hop))
    packets = [encoder._packet_of((signs[at : at + 2] * 2**28).astype(np.int32), np.zeros((0, 1))) for at in (0, 2)]
    samples = decoded(encoder.configuration, packets, 1)
    np.testing.assert_array_equal(documented(encoder.configuration, packets, 1), samples)
    assert {-32768, 32767} <= set(samples[:, 0].tolist())


@pytest.mark.parametrize("hop", mdct.HOPS)
@pytest.mark.parametrize("name", ["full-scale square", "sweep"])
def test_core_analyses_as_the_formula_says(hop: int, name: str) -> None:
    signal = edge_signals()[name][: 10 * hop]
    blocks = np.lib.stride_tricks.sliding_window_view(signal[:, 0], 2 * hop)[::hop]
    exact = blocks @ mdct.analysis_matrix(hop) * (256 * 32768)
    assert np.max(np.abs(mdct.spectra(signal, hop)[:, 0] - exact)) < 256 / 8


SHAPE = (2.0, 0.0, 0.2, 0.7, 1.6, 2.7, 2.5)


@pytest.mark.parametrize("hop", mdct.HOPS)
@pytest.mark.parametrize("quantiser_offsets", [None, [0, -30, 12, 336, -336]], ids=["", "rate-controlled"])
def test_core_agrees_with_the_documented_decoder_on_a_step_shape(hop: int, quantiser_offsets: list[int] | None) -> None:
    rate_control = in_turn(quantiser_offsets) if quantiser_offsets else None
    configuration, packets = coded(
        texture(1500, 2), 0.05, Framing(4 * hop, 5), hop, None, 1 / 8, rate_control, shape=SHAPE
    )
    np.testing.assert_array_equal(documented(configuration, packets, 2), decoded(configuration, packets, 2))


def test_a_step_shape_moves_the_error_to_where_steps_are_coarse() -> None:
    signal = np.random.default_rng(1).normal(0, 0.1, (8192, 1))
    spectra = []
    for shape in (None, (0.0, 0.0, 0.0, 0.0, 0.0, 2.6, 2.6)):
        configuration, packets = coded(signal, 0.02, Framing(1024, 0), 64, shape=shape)
        error = decoded(configuration, packets, 1)[64 : 64 + 8192] / 32768 - signal
        spectra.append(np.abs(np.fft.rfft(error[:, 0])) ** 2)
    low, high = (
        10 * np.log10(np.sum(spectra[1][part]) / np.sum(spectra[0][part])) for part in (slice(1024), slice(3584, None))
    )
    assert low < -4  # a shape of 2 bytes allows 4.5 dB here
    assert high > 5


@given(
    quantiser_offsets=st.lists(st.integers(-40, 40) | st.integers(-336, 336), min_size=1, max_size=8),
    hop=st.sampled_from(mdct.HOPS),
    channels=st.integers(1, 2),
    refresh_packets=st.integers(0, 4),
)
@settings(max_examples=15, deadline=None)
def test_core_agrees_with_the_documented_decoder_on_any_quantiser_offsets(
    quantiser_offsets: list[int], hop: int, channels: int, refresh_packets: int
) -> None:
    signal = texture(300, channels)
    framing = Framing(2 * hop, refresh_packets)
    configuration, packets = coded(
        signal, 0.1, framing, hop, noise_filling=1 / 8, rate_control=in_turn(quantiser_offsets)
    )
    np.testing.assert_array_equal(
        documented(configuration, packets, channels), decoded(configuration, packets, channels)
    )


@pytest.mark.parametrize("quantiser_offset", [0, 16, -32])
def test_a_constant_quantiser_offset_is_that_of_the_step_and_costs_at_most_a_bit_a_packet(
    quantiser_offset: int,
) -> None:
    signal = texture(50_000)
    plain = coded(signal, 0.125 * 2 ** (quantiser_offset / 16), Framing(128, 5), noise_filling=1 / 8)
    rate_controlled = coded(
        signal, 0.125, Framing(128, 5), noise_filling=1 / 8, rate_control=in_turn([quantiser_offset])
    )
    np.testing.assert_array_equal(decoded(*plain, 1), decoded(*rate_controlled, 1))
    added_bits = 8 * (sum(map(len, rate_controlled[1])) - sum(map(len, plain[1])))
    at_refreshes = 0 if quantiser_offset == 0 else 10 * len(plain[1]) / 5
    assert 0 <= added_bits <= len(plain[1]) + at_refreshes


def test_steps_per_packet_save_the_bits_of_a_click_above_a_texture() -> None:
    """The texture, 60 dB below the clicks, keeps its quality in half of the bytes."""
    signal = 1e-3 * texture(11_200)
    signal[700::1400] += 0.9

    def at_most_twice_a_packet_of_the_texture(trial: codec.Trial) -> Choice:
        return Choice(
            next(quantiser_offset for quantiser_offset in range(0, 336, 4) if len(trial.packet(quantiser_offset)) <= 30)
        )

    results = []
    for rate_control in (None, at_most_twice_a_packet_of_the_texture):
        configuration, packets = coded(signal, 2e-4, Framing(128, 5), rate_control=rate_control)
        played = decoded(configuration, packets, 1)[32:][: len(signal)] / 32768
        apart_from_clicks = (played - signal)[:, 0].reshape(-1, 1400)[:, 1050:]
        results.append((sum(map(len, packets)), float(np.std(apart_from_clicks))))
    (plain_bytes, plain_error), (rate_controlled_bytes, rate_controlled_error) = results
    assert rate_controlled_bytes < 0.5 * plain_bytes
    assert rate_controlled_error < plain_error


@pytest.mark.parametrize("tables", [b"", bytes(100), *(tables + b"\0" for tables in TABLES.values())])
def test_tables_of_another_size_are_rejected(tables: bytes) -> None:
    with pytest.raises(CodecError, match="tables"):
        mdct.MdctDecoder(mdct.configuration(32, 4, [500]), 1, tables)


@given(st.binary(min_size=1, max_size=40), st.sampled_from(mdct.HOPS))
@settings(max_examples=30)
def test_any_tables_decode_what_they_coded(pattern: bytes, hop: int) -> None:
    size = len(TABLES["built in"])
    tables = (pattern * size)[:size]
    signal = texture(600)
    configuration, packets = coded(signal, 0.05, Framing(2 * hop, 3), hop, tables)
    samples = decoded(configuration, packets, 1, tables)
    ratio = codec.snr_db(signal, samples[hop : hop + 600] / 32768)
    assert ratio is not None
    assert ratio > 5


@pytest.mark.parametrize("tail", [b"\0", b"\x02", b"\x01\x01", b"\x04", b"\x04\x10\0\0", b"\x04\x10\0\0\0", b"\x08"])
def test_a_configuration_that_ends_otherwise_is_rejected(tail: bytes) -> None:
    with pytest.raises(CodecError, match="configuration"):
        mdct.MdctDecoder(mdct.configuration(32, 4, [500]) + tail, 1)


def test_a_file_takes_the_hop_that_suits_it_and_a_live_stream_the_short_one() -> None:
    time_s = np.arange(5600) / RATE_HZ
    tone = np.sin(2 * np.pi * 180.3 * time_s)[:, None]
    clicks = np.zeros((5600, 1))
    clicks[50::400] = 1.0
    hops = {
        name: codec.decoder(1, codec.encode(signal, RATE_HZ, {"step": 0.1}, live=live).configuration, 1).delay_samples
        for name, signal, live in (("tone", tone, False), ("clicks", clicks, False), ("live", tone, True))
    }
    assert hops == {"tone": 128, "clicks": 16, "live": 32}
    asked = codec.encode(clicks, RATE_HZ, {"step": 0.1, "hop": "64"}, live=True)
    assert codec.decoder(1, asked.configuration, 1).delay_samples == 64


def test_fill_takes_the_place_of_zeros_and_leaves_silence() -> None:
    tone = np.sin(2 * np.pi * 100 * np.arange(1400) / RATE_HZ)[:, None]
    signal = np.concatenate([tone, np.zeros((1400, 1))])
    filled, bare = (
        codec.decode(codec.encode(signal, RATE_HZ, {"step": 1, "hop": "32", "noise_filling": noise_filling}))
        for noise_filling in (0.1, 0)
    )
    above_700_hz = [np.sqrt(np.mean(np.abs(np.fft.rfft(samples[:1344, 0])[336:]) ** 2)) for samples in (filled, bare)]
    assert above_700_hz[0] > 5 * above_700_hz[1]
    assert not np.any(filled[1500:])


def test_other_tables_decode_what_they_coded() -> None:
    signal = texture(3000)
    trainer = mdct.MdctEncoder([0.02], RATE_HZ, Framing(128, 0))
    trainer.encode(signal)
    tables = trainer.adapted_tables()
    coded_signal = codec.encode(signal, RATE_HZ, {"step": 0.3}, model=codec.Model(tables))
    built_in = codec.encode(signal, RATE_HZ, {"step": 0.3})
    assert coded_signal.packets != built_in.packets
    assert not np.array_equal(codec.decode_integers(coded_signal), codec.decode_integers(coded_signal, tables))
    assert codec.snr_db(signal, codec.decode(coded_signal, tables)) == pytest.approx(
        codec.snr_db(signal, codec.decode(built_in)), abs=0.5
    )


@pytest.mark.parametrize(
    ("steps", "framing", "hop"),
    [
        ([], Framing(32, 0), 32),
        ([0.1] * 17, Framing(32, 0), 32),
    ]
    + [([step], Framing(32, 0), 32) for step in (0.0, -1.0, float("nan"), float("inf"))]
    + [([0.1], Framing(32, 0), 48)],
)
def test_parameters_out_of_range_are_rejected(steps: list[float], framing: Framing, hop: int) -> None:
    with pytest.raises(CodecError):
        mdct.MdctEncoder(steps, RATE_HZ, framing, hop=hop)


@pytest.mark.parametrize("noise_filling", [-0.01, 0.25, float("nan")])
def test_noise_filling_out_of_range_is_rejected(noise_filling: float) -> None:
    with pytest.raises(CodecError, match="noise_filling"):
        mdct.MdctEncoder([0.1], RATE_HZ, Framing(32, 0), noise_filling=noise_filling)


def test_longest_packets() -> None:
    encoder = mdct.MdctEncoder([0.5], RATE_HZ, Framing(2047 * 32, 0))
    (packet,) = encoder.encode(np.zeros((2047 * 32, 1)))
    assert len(mdct.MdctDecoder(encoder.configuration, 1).decode(packet)) == 2047 * 32


@given(st.floats(2.0**-17, 2.0**10))
def test_step_codes_are_within_one_percent(step: float) -> None:
    code = mdct.step_code(step)
    value = (64 + code % 64) * 2.0 ** (code // 64) / (32768 * 256)
    assert value == pytest.approx(min(step, 127 * 2.0**20 / (32768 * 256)), rel=0.01)
