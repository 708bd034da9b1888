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
from vibrocast.codec import CodecError, Framing, RateControl, core, mdct
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


@pytest.mark.parametrize("hop", core.HOPS)
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


@pytest.mark.parametrize("hop", core.HOPS)
def test_core_agrees_with_the_documented_decoder_beyond_full_scale(hop: int) -> None:
    """Coefficients that only a hostile stream has, which the transform shifts down."""
    encoder = mdct.MdctEncoder([2.0**-3], RATE_HZ, Framing(2 * hop, 0), hop=hop)
    signs = np.random.default_rng(hop).choice([-1, 1], (4, 1, hop))
    packets = [encoder._packet_of((signs[at : at + 2] * 2**28).astype(np.int32), np.zeros((0, 1))) for at in (0, 2)]
    samples = decoded(encoder.configuration, packets, 1)
    np.testing.assert_array_equal(documented(encoder.configuration, packets, 1), samples)
    assert {-32768, 32767} <= set(samples[:, 0].tolist())


SHAPE = (2.0, 0.0, 0.2, 0.7, 1.6, 2.7, 2.5)


@pytest.mark.parametrize("hop", core.HOPS)
@pytest.mark.parametrize("quantiser_offsets", [None, [0, -30, 12, 336, -336]], ids=["", "rate-controlled"])
def test_core_agrees_with_the_documented_decoder_on_a_step_shape(hop: int, quantiser_offsets: list[int] | None) -> None:
    rate_control = in_turn(quantiser_offsets) if quantiser_offsets else None
    configuration, packets = coded(
        texture(1500, 2), 0.05, Framing(4 * hop, 5), hop, None, 1 / 8, rate_control, shape=SHAPE
    )
    np.testing.assert_array_equal(documented(configuration, packets, 2), decoded(configuration, packets, 2))


@given(
    quantiser_offsets=st.lists(st.integers(-40, 40) | st.integers(-336, 336), min_size=1, max_size=8),
    hop=st.sampled_from(core.HOPS),
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


@pytest.mark.parametrize("tables", [b"", bytes(100), *(tables + b"\0" for tables in TABLES.values())])
def test_tables_of_another_size_are_rejected(tables: bytes) -> None:
    with pytest.raises(CodecError, match="tables"):
        mdct.MdctDecoder(mdct.configuration(32, 4, [500]), 1, tables)


@given(st.binary(min_size=1, max_size=40), st.sampled_from(core.HOPS))
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
        name: codec.decoder(
            1, codec.encode(signal, RATE_HZ, {"step": 0.1}, live=live).header.configuration, 1
        ).delay_samples
        for name, signal, live in (("tone", tone, False), ("clicks", clicks, False), ("live", tone, True))
    }
    assert hops == {"tone": 128, "clicks": 16, "live": 32}
    asked = codec.encode(clicks, RATE_HZ, {"step": 0.1, "hop": "64"}, live=True)
    assert codec.decoder(1, asked.header.configuration, 1).delay_samples == 64


@given(st.floats(2.0**-17, 2.0**10))
def test_step_codes_are_within_one_percent(step: float) -> None:
    code = core.step_code(step)
    value = (64 + code % 64) * 2.0 ** (code // 64) / (32768 * 256)
    assert value == pytest.approx(min(step, 127 * 2.0**20 / (32768 * 256)), rel=0.01)
