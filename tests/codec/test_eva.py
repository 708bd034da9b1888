"""The codec `eva`: its core against a numpy decoder, ONNX Runtime, its prior, hostile models."""

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.codec.eva_models import model_with, random_image, tiny_model, with_extreme_weights
from tests.codec.eva_reference_decoder import EvaReferenceDecoder
from tests.codec.signals import RATE_HZ, in_turn, played, texture
from vibrocast import codec
from vibrocast.codec import CodecError, Framing, Model, RateControl, eva
from vibrocast.codec.core import STEP_CODES
from vibrocast.codec.eva_image import PRIOR_KINDS, EvaImage, PriorKind, with_runtime
from vibrocast.codec.graphs import LATENTS, SIGNAL, transform
from vibrocast.firmware.native_core import Structure, ffi, library

TINY = tiny_model()


def coded(signal: codec.Signal, rate_control: RateControl | None = None) -> tuple[bytes, list[bytes]]:
    encoder = eva.EvaEncoder([0.2] * signal.shape[1], Framing(128, 5), TINY, rate_control)
    packets = encoder.encode(signal) + encoder.finish()
    return encoder.configuration, packets


def decoded(configuration: bytes, packets: list[bytes], channels: int, runtime: str = "core") -> codec.Decoded:
    decoder = eva.make_decoder(configuration, channels, with_runtime(TINY.tables, runtime))
    return played(decoder, packets)


def random_levels(seed: int, shape: tuple[int, ...], scale: float) -> NDArray[np.int32]:
    """Return levels of latents of this magnitude."""
    return np.asarray(np.rint(np.random.default_rng(seed).laplace(0, scale, shape)), dtype=np.int32)


def random_packets(
    image: EvaImage, seed: int, channels: int, columns: int, scale: float, quantiser_offsets: Sequence[int] = ()
) -> tuple[bytes, list[bytes]]:
    """Return a configuration and packets of random levels of this magnitude; rate-controlled on request."""
    level_codes = [int(code) for code in np.random.default_rng(seed).integers(0, STEP_CODES, channels)]
    configuration = eva.configuration(columns, level_codes, rate_controlled=bool(quantiser_offsets))
    encoder = eva.LatentEncoder(configuration, channels, image.pack(), 2)
    levels = random_levels(seed, (3, channels, image.latents, columns), scale)
    turn = zip(levels, itertools.cycle(quantiser_offsets or [0]), strict=False)
    return configuration, [encoder.encode(list(packet), quantiser_offset) for packet, quantiser_offset in turn]


@given(
    seed=st.integers(0, 2**16),
    width=st.integers(1, 40),
    latents=st.integers(1, 40),
    prior=st.sampled_from(PRIOR_KINDS),
    channels=st.integers(1, 3),
    columns=st.integers(1, 30),
    scale=st.sampled_from([0.05, 0.5, 3.0, 1e6]),
    extreme=st.booleans(),
    quantiser_offsets=st.lists(st.integers(-40, 40) | st.integers(-(2**31), 2**31 - 1), max_size=3),
)
@settings(max_examples=60, deadline=None)
def test_core_gives_the_integers_of_the_numpy_decoder(
    seed: int,
    width: int,
    latents: int,
    prior: PriorKind,
    channels: int,
    columns: int,
    scale: float,
    extreme: bool,
    quantiser_offsets: list[int],
) -> None:
    image = random_image(seed, width, latents, prior)
    if extreme:
        image = with_extreme_weights(image, seed)
    configuration, packets = random_packets(image, seed, channels, columns, scale, quantiser_offsets)
    decoder = eva.EvaDecoder(configuration, channels, image.pack())
    reference = EvaReferenceDecoder(configuration, channels, image.pack())
    samples = np.concatenate([decoder.decode(packet) for packet in packets])
    np.testing.assert_array_equal(samples, reference.samples(packets))


def test_core_gives_the_integers_of_the_numpy_decoder_for_the_widest_model() -> None:
    image = random_image(1, 128, 128)
    configuration, packets = random_packets(image, 1, 1, 5, 2.0)
    decoder = eva.EvaDecoder(configuration, 1, image.pack())
    samples = np.concatenate([decoder.decode(packet) for packet in packets])
    np.testing.assert_array_equal(samples, EvaReferenceDecoder(configuration, 1, image.pack()).samples(packets))


def test_core_gives_the_integers_of_the_numpy_decoder_for_a_trained_model() -> None:
    configuration, packets = coded(texture(1500, 2))
    samples = EvaReferenceDecoder(configuration, 2, TINY.tables).samples(packets)
    np.testing.assert_array_equal(decoded(configuration, packets, 2), samples)
    assert np.std(samples) > 1000


@pytest.mark.parametrize("runtime", codec.RUNTIMES)
def test_a_constant_quantiser_offset_of_0_is_the_step_of_1_and_costs_at_most_a_bit_a_packet(runtime: str) -> None:
    signal = texture(30_000)
    plain, rate_controlled = coded(signal), coded(signal, rate_control=in_turn([0]))
    np.testing.assert_array_equal(decoded(*plain, 1, runtime), decoded(*rate_controlled, 1, runtime))
    assert 0 < 8 * (sum(map(len, rate_controlled[1])) - sum(map(len, plain[1]))) <= len(plain[1])


def snrs_db(signal: codec.Signal, setting: codec.Setting) -> tuple[float, float]:
    """SNR decoded by the core and by ONNX Runtime."""
    stream = codec.encode(signal, RATE_HZ, setting, codec="eva", model=TINY)
    ratios = [codec.snr_db(signal, replace(stream, runtime=runtime).decode()) for runtime in ("core", "onnx")]
    assert ratios[0] is not None and ratios[1] is not None
    return ratios[0], ratios[1]


def test_integers_lose_less_than_a_third_of_a_decibel() -> None:
    for seed in range(3):
        core_db, onnx_db = snrs_db(texture(4000, seed=seed), {})
        assert 16 < onnx_db < 21
        assert core_db > onnx_db - 0.3


def test_onnx_runtime_gives_packets_what_it_gives_all_at_once() -> None:
    configuration, packets = coded(texture(2000))
    latents = EvaReferenceDecoder(configuration, 1, TINY.tables).latents(packets)[0]
    image = EvaImage.unpack(TINY.tables)
    values = (latents.T[None] * np.exp2(-image.fraction_bits.astype(float))[:, None]).astype(np.float32)
    exact = transform(image.graph, LATENTS, SIGNAL)(values)[0, 0] * 0.2 * 32768
    played = decoded(configuration, packets, 1, "onnx")[:, 0]
    assert np.max(np.abs(played[28:] - exact[: len(played) - 28])) < 1 + 0.01 * np.max(np.abs(exact))
    near = played[28:] / np.linalg.norm(played[28:]) - exact[:-28] / np.linalg.norm(exact)
    assert np.linalg.norm(near) < 0.002


@given(
    st.dictionaries(st.integers(0, 2**16), st.integers(0, 255), max_size=3), st.binary(max_size=8), st.integers(0, 9)
)
@settings(max_examples=60, deadline=None)
def test_the_core_reads_the_models_that_python_reads(damage: dict[int, int], tail: bytes, cut: int) -> None:
    for prior in PRIOR_KINDS:
        damaged = bytearray(random_image(1, prior=prior).pack())
        for position, byte in damage.items():
            damaged[position % (16 if position % 2 else len(damaged))] = byte
        payload = bytes(damaged[: len(damaged) - cut]) + tail
        valid = False
        with suppress(CodecError):
            EvaImage.unpack(payload)
            valid = True
        configuration = eva.configuration(1, [0])
        decoder = Structure(library().vc_eva_decoder_size(), "vc_eva_decoder *")
        memory = ffi.new("uint8_t[]", payload)
        status = library().vc_eva_decoder_init(
            decoder.pointer, configuration, len(configuration), 1, memory, len(payload)
        )
        assert (status == library().VC_OK) == valid


def test_a_model_without_integers_is_decoded_by_onnx_runtime_alone() -> None:
    payload = replace(EvaImage.unpack(TINY.tables), network=None, runtime="onnx").pack()
    signal = texture(2000)
    stream = codec.encode(signal, RATE_HZ, {}, codec="eva", model=model_with(payload, TINY.analysis))
    onnx = replace(stream, runtime="onnx")
    np.testing.assert_array_equal(stream.decode_integers(), onnx.decode_integers())
    with pytest.raises(CodecError, match="no integer network"):
        codec.decoder(eva.IDENTIFIER, stream.header.configuration, 1, payload, "core")
    core = eva.EvaDecoder(stream.header.configuration, 1, payload)
    with pytest.raises(CodecError):
        core.decode(stream.packets[0])


def test_each_runtime_is_chosen_by_the_image_or_by_name() -> None:
    configuration, _ = coded(texture(300))
    for preferred in codec.RUNTIMES:
        for asked in (None, *codec.RUNTIMES):
            tables = with_runtime(TINY.tables, preferred)
            decoder = codec.decoder(eva.IDENTIFIER, configuration, 1, tables, asked)
            assert isinstance(decoder, eva.OnnxDecoder) == ((asked or preferred) == "onnx")


def test_foreign_graphs_are_rejected() -> None:
    image = EvaImage.unpack(TINY.tables)
    signal = texture(300)

    def encoded(model: Model) -> codec.Stream:
        return codec.encode(signal, RATE_HZ, {}, codec="eva", model=model)

    with pytest.raises(CodecError, match="brings no analysis"):
        encoded(model_with(TINY.tables))
    with pytest.raises(CodecError, match="ONNX graph"):
        encoded(model_with(TINY.tables, b"not a graph"))
    with pytest.raises(CodecError, match="ONNX graph"):
        encoded(model_with(TINY.tables, image.graph))
    with pytest.raises(CodecError, match="export it again"):
        encoded(model_with(random_image(1).pack(), TINY.analysis))
    for graph in (b"not a graph", TINY.analysis):
        with pytest.raises(CodecError, match="ONNX graph"):
            codec.check_tables(eva.IDENTIFIER, replace(image, graph=graph, runtime="onnx").pack())
    codec.check_tables(eva.IDENTIFIER, TINY.tables)


@pytest.mark.parametrize("gain", [1e-30, 1e-3, 1.0, 1e30])
def test_the_level_of_a_signal_does_not_matter(gain: float) -> None:
    signal = texture(2000)
    assert snrs_db(gain * signal, {})[0] == pytest.approx(snrs_db(signal, {})[0], abs=0.3)


@pytest.mark.parametrize("level", [0.01, 100.0])
def test_far_levels_saturate_without_wrapping(level: float) -> None:
    """Far too hot or too quiet for the integers, the signal loses quality but keeps its sign."""
    signal = texture(2000)
    stream = codec.encode(signal, RATE_HZ, {"level": level}, codec="eva", model=TINY)
    result = stream.decode()
    assert np.max(np.abs(result)) <= 1.0
    assert float(np.sum(signal * result)) >= 0


def test_dc_is_kept_as_far_as_the_model_knows_it_and_silence_is_silent() -> None:
    assert not np.any(codec.encode(np.zeros((2000, 1)), RATE_HZ, {}, codec="eva", model=TINY).decode())
    core_db, onnx_db = snrs_db(np.full((2800, 1), 0.5), {})
    assert core_db > onnx_db - 0.3
    assert core_db > 10


def test_an_snr_is_met_in_every_channel_and_a_rate_in_all() -> None:
    signal = np.hstack([texture(2800), 0.1 * texture(2800, seed=4)])
    stream = codec.encode_to_snr(codec.Source.of(signal, RATE_HZ, codec="eva", model=TINY), 20.0)
    for ratio_db in codec.channel_snrs_db(signal, stream.decode()):
        assert ratio_db == pytest.approx(20.0, abs=codec.SNR_TOLERANCE_DB)

    for wanted in (16_000, 20_000):
        at_rate = codec.encode_to_rate(codec.Source.of(signal, RATE_HZ, codec="eva", model=TINY), wanted)
        assert at_rate.bits_per_second == pytest.approx(wanted, rel=codec.RATE_TOLERANCE)
