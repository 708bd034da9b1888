"""The codec `mdct`: its core against a decoder written from the documentation, loss, hostile bytes, a golden stream."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import codec
from codec import CodecError, Framing, mdct
from device_protocol.coded_stream import unpack_file
from tests.codec.reference_decoder import ReferenceDecoder
from tests.codec.signals import RATE_HZ, edge_signals, texture


def coded(signal: codec.Signal, step: float, framing: Framing, hop: int | None = None) -> tuple[bytes, list[bytes]]:
    encoder = mdct.MdctEncoder([step] * signal.shape[1], RATE_HZ, framing, hop=hop)
    packets = encoder.encode(signal) + encoder.finish()
    return encoder.configuration, packets


def decoded(configuration: bytes, packets: list[bytes], channels: int) -> codec.Decoded:
    decoder = mdct.MdctDecoder(configuration, channels)
    return np.concatenate([decoder.decode(packet) for packet in packets])


@pytest.mark.parametrize("hop", mdct.HOPS)
@pytest.mark.parametrize("channels", [1, 3])
def test_core_agrees_with_the_documented_decoder(hop: int, channels: int) -> None:
    """Levels equal, and samples at least 80 dB below full scale from the exact transform."""
    configuration, packets = coded(texture(1500, channels), 0.05, Framing(4 * hop, 5), hop)
    reference = ReferenceDecoder(configuration, channels, mdct.built_in_tables())
    exact = np.concatenate([reference.samples(packet) for packet in packets])
    difference = np.clip(exact, -32768, 32767) - decoded(configuration, packets, channels)
    assert np.max(np.abs(difference)) < 0.51
    assert 20 * np.log10(np.sqrt(np.mean(difference**2)) / 32768) < -80


@pytest.mark.parametrize("name", ["impulses", "full-scale square", "four-bit", "sweep"])
def test_core_agrees_with_the_documented_decoder_at_fine_steps(name: str) -> None:
    signal = edge_signals()[name][:700]
    configuration, packets = coded(signal, 2.0**-14, Framing(256, 0))
    reference = ReferenceDecoder(configuration, 1, mdct.built_in_tables())
    exact = np.concatenate([reference.samples(packet) for packet in packets])
    assert np.max(np.abs(np.clip(exact, -32768, 32767) - decoded(configuration, packets, 1))) < 0.51


@given(st.integers(0, 3), st.lists(st.integers(1, 400), min_size=1, max_size=8))
@settings(max_examples=25)
def test_packets_do_not_depend_on_how_samples_arrive(seed: int, lengths: list[int]) -> None:
    signal = texture(sum(lengths), 2, seed)
    whole = coded(signal, 0.1, Framing(96, 4))
    encoder = mdct.MdctEncoder([0.1, 0.1], RATE_HZ, Framing(96, 4))
    packets = [packet for part in np.split(signal, np.cumsum(lengths)[:-1]) for packet in encoder.encode(part)]
    assert (encoder.configuration, packets + encoder.finish()) == whole


@given(st.sets(st.integers(0, 39), max_size=39))
@settings(max_examples=60)
def test_a_lost_packet_costs_at_most_one_interval_and_fades(lost: set[int]) -> None:
    signal = texture(40 * 128 - 32)
    framing = Framing(128, 5)
    configuration, packets = coded(signal, 0.05, framing)
    clean = decoded(configuration, packets, 1).astype(int)
    decoder = mdct.MdctDecoder(configuration, 1)
    playing = True
    for index, packet in enumerate(packets):
        part = decoder.conceal() if index in lost else decoder.decode(packet)
        expected = clean[index * 128 : (index + 1) * 128]
        before_playing = playing
        playing = index not in lost and (playing or index % framing.refresh_packets == 0)
        if playing:
            # After a gap the first hop rises under the window; from then on the samples are those of the clean stream.
            assert np.array_equal(part[0 if before_playing else 32 :], expected[0 if before_playing else 32 :])
        assert np.max(np.abs(part.astype(int))) <= 2 * np.max(np.abs(clean))


def test_concealment_fades_within_one_packet_and_stays_silent() -> None:
    configuration, packets = coded(texture(2000), 0.05, Framing(128, 5))
    decoder = mdct.MdctDecoder(configuration, 1)
    for packet in packets[:5]:
        last = decoder.decode(packet)
    fade = decoder.conceal().astype(float)
    assert np.any(fade)
    assert np.std(fade[-32:]) < 0.5 * np.std(last)
    assert not np.any(decoder.conceal()[32:])
    assert not np.any(decoder.conceal())


def test_a_packet_out_of_order_is_not_played() -> None:
    configuration, packets = coded(texture(2000), 0.05, Framing(128, 5))
    decoder = mdct.MdctDecoder(configuration, 1)
    assert not np.any(decoder.decode(packets[1])), "the first packet must be a refresh"
    decoder.decode(packets[0])
    decoder.decode(packets[3])
    decoder.decode(packets[4])
    assert not np.any(decoder.decode(packets[6]))


@given(
    st.binary(max_size=60),
    st.sampled_from([1, 2, 16]),
    st.sampled_from(mdct.HOPS),
    st.lists(st.binary(max_size=200), max_size=6),
)
@settings(max_examples=80)
def test_any_bytes_decode_safely(head: bytes, channels: int, hop: int, payloads: list[bytes]) -> None:
    decoder = mdct.MdctDecoder(mdct.configuration(hop, 3, [mdct.STEP_CODES - 1] * channels), channels)
    for payload in [b"\x01", b"\x01" + head, *payloads]:
        try:
            samples = decoder.decode(payload)
        except CodecError:
            samples = decoder.conceal()
        assert samples.shape == (3 * hop, channels)


@given(st.binary(max_size=40), st.integers(-1, 20))
def test_any_configuration_is_read_or_refused(configuration: bytes, channels: int) -> None:
    try:
        decoder = mdct.MdctDecoder(configuration, channels)
    except CodecError:
        return
    assert len(decoder.conceal()) == decoder.packet_samples <= 4095 * 64


@pytest.mark.parametrize("tables", [b"", bytes(100), mdct.built_in_tables() + b"\0"])
def test_tables_of_another_size_are_refused(tables: bytes) -> None:
    with pytest.raises(CodecError, match="tables"):
        mdct.MdctDecoder(mdct.configuration(32, 4, [500]), 1, tables)


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
        ([0.1], Framing(0, 0), 32),
        ([0.1], Framing(4096 * 32, 0), 32),
        ([], Framing(32, 0), 32),
        ([0.1] * 17, Framing(32, 0), 32),
    ]
    + [([step], Framing(32, 0), 32) for step in (0.0, -1.0, float("nan"), float("inf"))]
    + [([0.1], Framing(32, 0), 48)],
)
def test_parameters_out_of_range_are_refused(steps: list[float], framing: Framing, hop: int) -> None:
    with pytest.raises(CodecError):
        mdct.MdctEncoder(steps, RATE_HZ, framing, hop=hop)


def test_a_packet_that_does_not_fit_is_refused() -> None:
    encoder = mdct.MdctEncoder([2.0**-17] * 16, RATE_HZ, Framing(32 * 512, 0))
    noise = np.random.default_rng(1).uniform(-1, 1, (32 * 600, 16))
    with pytest.raises(CodecError, match="shorter packets"):
        encoder.encode(noise)


def test_longest_packets() -> None:
    encoder = mdct.MdctEncoder([0.5], RATE_HZ, Framing(4095 * 32, 0))
    (packet,) = encoder.encode(np.zeros((4095 * 32, 1)))
    assert len(mdct.MdctDecoder(encoder.configuration, 1).decode(packet)) == 4095 * 32


@given(st.floats(2.0**-17, 2.0**10))
def test_step_codes_are_within_one_percent(step: float) -> None:
    code = mdct.step_code(step)
    value = (64 + code % 64) * 2.0 ** (code // 64) / (32768 * 256)
    assert value == pytest.approx(min(step, 127 * 2.0**20 / (32768 * 256)), rel=0.01)


def golden_signal() -> codec.Signal:
    """Made of integers only, so that every machine has the same: (400, 2)."""
    state, values = 1, []
    for _ in range(800):
        state = (state * 1103515245 + 12345) % 2**31
        values.append((state >> 16) % 256 - 128)
    return np.array(values, dtype=np.float64).reshape(400, 2).cumsum(axis=0) / 8192


def test_golden_stream() -> None:
    """A stream of version 1 stays playable, to the last bit: a change here is a new version of the format."""
    header, packets = unpack_file(Path(__file__).with_name("golden_mdct.vct").read_bytes())
    assert (header.samples, header.channels, len(packets)) == (400, 2, 3)
    samples = decoded(header.configuration, packets, header.channels)
    assert hashlib.sha256(samples.astype("<i2").tobytes()).hexdigest()[:32] == "e70232474de8c5fc7b7c18bd083c6401"
    ratio = codec.snr_db(golden_signal(), samples[32:432] * (np.array(header.gains) / 32768))
    assert ratio == pytest.approx(32.23, abs=0.01)
