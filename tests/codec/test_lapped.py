"""The codec `lapped`: its core against the documented decoder, its transform, loss, hostile models, a golden stream."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.codec.reference_decoder import LappedReferenceDecoder
from tests.codec.signals import RATE_HZ, edge_signals, texture
from tests.codec.test_mdct import golden_signal, in_turn
from vibrocast import codec, models
from vibrocast.codec import CodecError, Framing, Model, RateControl, SignalFormat, lapped, mdct
from vibrocast.codec.mdct import MdctEncoder
from vibrocast.device_protocol.coded_stream import unpack_file

MODEL = models.find("lapped-textures").tables


def encoder_of(
    channels: int,
    step: float,
    framing: Framing,
    hop: int,
    payload: bytes = MODEL,
    noise_filling: float = 0.0,
    rate_control: RateControl | None = None,
) -> MdctEncoder:
    signal_format = SignalFormat(RATE_HZ, "full scale", (1.0,) * channels, (1.0,) * channels)
    setting = lapped.CODEC.complete({"step": step, "hop": str(hop), "noise_filling": noise_filling})
    return lapped.make_encoder(setting, signal_format, framing, Model(payload), rate_control)


def decoded(encoder: MdctEncoder, packets: list[bytes], channels: int, payload: bytes = MODEL) -> codec.Decoded:
    decoder = lapped.LappedDecoder(encoder.configuration, channels, payload)
    return np.concatenate([decoder.decode(packet) for packet in packets])


@pytest.mark.parametrize("hop", mdct.HOPS)
@pytest.mark.parametrize(("channels", "noise_filling"), [(1, 0.0), (3, 1 / 32)])
def test_core_agrees_with_the_documented_decoder(hop: int, channels: int, noise_filling: float) -> None:
    signal = np.concatenate([texture(800, channels), np.zeros((600, channels)), texture(400, channels)])
    rate_control = in_turn([0, 12, -20]) if channels > 1 else None
    encoder = encoder_of(
        channels, 0.05, Framing(4 * hop, 5), hop, noise_filling=noise_filling, rate_control=rate_control
    )
    packets = encoder.encode(signal) + encoder.finish()
    reference = LappedReferenceDecoder(encoder.configuration, channels, MODEL)
    exact = np.concatenate([reference.samples(packet) for packet in packets])
    assert np.max(np.abs(np.clip(exact, -32768, 32767) - decoded(encoder, packets, channels))) < 0.51


@pytest.mark.parametrize("hop", mdct.HOPS)
def test_the_transform_of_the_model_that_ships_is_orthogonal(hop: int) -> None:
    """Basis functions of a block and of the three next ones are orthonormal: so the transpose reconstructs."""
    matrix = lapped.analysis_matrix(MODEL[: lapped.WINDOWS_BYTES], hop)
    for later in range(4):
        product = matrix[later * hop :].T @ matrix[: (4 - later) * hop]
        np.testing.assert_allclose(product, np.eye(hop) * (later == 0), atol=2e-4)


@pytest.mark.parametrize("hop", mdct.HOPS)
@pytest.mark.parametrize("name", edge_signals())
def test_fine_steps_reconstruct_any_signal(name: str, hop: int) -> None:
    signal = 0.5 * edge_signals()[name][:700] / max(1.0, np.max(np.abs(edge_signals()[name])))
    encoder = encoder_of(signal.shape[1], 2.0**-13, Framing(256, 0), hop)
    packets = encoder.encode(signal) + encoder.finish()
    delay_samples = encoder.delay_samples
    assert delay_samples == 3 * hop
    played = decoded(encoder, packets, signal.shape[1])[delay_samples:][: len(signal)] / 32768
    assert np.max(np.abs(played - signal)) < 1e-3


@given(st.integers(0, 3), st.lists(st.integers(1, 400), min_size=1, max_size=8), st.sampled_from(mdct.HOPS))
@settings(max_examples=15, deadline=None)
def test_packets_do_not_depend_on_how_samples_arrive(seed: int, lengths: list[int], hop: int) -> None:
    signal = texture(sum(lengths), 2, seed)
    whole, in_parts = (encoder_of(2, 0.1, Framing(128, 4), hop) for _ in range(2))
    packets = [packet for part in np.split(signal, np.cumsum(lengths)[:-1]) for packet in in_parts.encode(part)]
    assert packets + in_parts.finish() == whole.encode(signal) + whole.finish()


@given(st.sets(st.integers(0, 29), max_size=29))
@settings(max_examples=20, deadline=None)
def test_a_lost_packet_costs_at_most_one_interval_and_fades(lost: set[int]) -> None:
    encoder = encoder_of(1, 0.05, Framing(128, 5), 32)
    packets = encoder.encode(texture(30 * 128))[:30]
    clean = decoded(encoder, packets, 1).astype(int)
    decoder = lapped.LappedDecoder(encoder.configuration, 1, MODEL)
    playing = True
    for index, packet in enumerate(packets):
        part = decoder.conceal() if index in lost else decoder.decode(packet)
        begins = 0 if playing else 96  # three hops rise under the window
        playing = index not in lost and (playing or index % 5 == 0)
        if playing:
            np.testing.assert_array_equal(part[begins:], clean[index * 128 :][begins:128])
        assert np.max(np.abs(part.astype(int))) <= 2 * np.max(np.abs(clean))


def test_concealment_fades_and_stays_silent() -> None:
    encoder = encoder_of(1, 0.05, Framing(128, 5), 32)
    packets = encoder.encode(texture(2000))
    decoder = lapped.LappedDecoder(encoder.configuration, 1, MODEL)
    for packet in packets[:5]:
        decoder.decode(packet)
    assert np.any(decoder.conceal())
    assert not np.any(decoder.conceal()[96:])
    assert not np.any(decoder.conceal())


@given(st.binary(min_size=1, max_size=40), st.sampled_from(mdct.HOPS), st.lists(st.binary(max_size=200), max_size=4))
@settings(max_examples=30, deadline=None)
def test_any_windows_and_packets_decode_safely(pattern: bytes, hop: int, payloads: list[bytes]) -> None:
    model = (pattern * len(MODEL))[: lapped.WINDOWS_BYTES] + MODEL[lapped.WINDOWS_BYTES :]
    configuration = mdct.configuration(hop, 3, [1000], noise_filling_code=31)
    decoder = lapped.LappedDecoder(configuration, 1, model)
    for payload in [b"\x01\xff", *(b"\x01" + payload for payload in payloads)]:
        samples = decoder.decode(payload)
        assert samples.shape == (3 * hop, 1)
        assert decoder.conceal().shape == (3 * hop, 1)


@pytest.mark.parametrize("size", [0, 1, 959, 960, 961, len(MODEL) - 1, len(MODEL) + 1])
def test_models_of_another_size_are_rejected(size: int) -> None:
    payload = (MODEL + bytes(8))[:size]
    with pytest.raises(CodecError, match=r"windows of lapped take|tables"):
        lapped.LappedDecoder(mdct.configuration(32, 4, [500]), 1, payload)
    with pytest.raises(CodecError, match=r"windows of lapped take|tables"):
        codec.encode(texture(100), RATE_HZ, {}, codec="lapped", model=Model(payload))
    with pytest.raises(CodecError, match=r"windows of lapped take|tables"):
        codec.check_tables(lapped.IDENTIFIER, payload)


def test_other_tables_are_taken() -> None:
    model = MODEL[: lapped.WINDOWS_BYTES] + mdct.built_in_tables()
    signal = texture(3000)
    stream = codec.encode(signal, RATE_HZ, {"step": 0.2}, codec="lapped", model=Model(model))
    assert (codec.snr_db(signal, codec.decode(stream, model)) or 0) > 10


def test_a_file_takes_the_hop_that_suits_it_and_a_live_stream_the_short_one() -> None:
    time_s = np.arange(5600) / RATE_HZ
    tone = np.sin(2 * np.pi * 180.3 * time_s)[:, None]
    clicks = np.zeros((5600, 1))
    clicks[50::400] = 1.0
    delays_samples = []
    for signal, live in ((tone, False), (clicks, False), (tone, True)):
        stream = codec.encode(signal, RATE_HZ, {"step": 0.1}, codec="lapped", live=live, model=Model(MODEL))
        decoder = codec.decoder(lapped.IDENTIFIER, stream.configuration, 1, MODEL)
        delays_samples.append(decoder.delay_samples)
    assert delays_samples == [3 * 128, 3 * 16, 3 * 32]


def test_golden_stream() -> None:
    """A stream of format 3 stays playable, to the last bit: a change here is a new version of the format."""
    header, packets = unpack_file(Path(__file__).with_name("golden_lapped.vct").read_bytes())
    assert (header.codec_identifier, header.samples, header.channels, len(packets)) == (
        lapped.IDENTIFIER,
        400,
        2,
        5,
    )
    model = models.by_hash(header.image_hash)
    assert model is not None
    decoder = lapped.LappedDecoder(header.configuration, header.channels, model.tables)
    samples = np.concatenate([decoder.decode(packet) for packet in packets])
    assert hashlib.sha256(samples.astype("<i2").tobytes()).hexdigest()[:32] == "7a5c28e00703379e37db54261883882d"
    begin = decoder.delay_samples
    ratio = codec.snr_db(golden_signal(), samples[begin : begin + 400] * (np.array(header.gains) / 32768))
    assert ratio == pytest.approx(30.25, abs=0.01)
