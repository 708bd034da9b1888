"""The codec `slp`: its core against a decoder written from the documentation, stability, quantisers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.codec.signals import RATE_HZ, difference, edge_signals, in_turn, played, texture
from tests.codec.slp_reference_decoder import SlpReferenceDecoder
from vibrocast import codec
from vibrocast.codec import CodecError, Framing, RateControl, Setting, SignalFormat, slp
from vibrocast.codec.core import CoreDecoder
from vibrocast.evaluation.stability import filters


def coded(
    signal: codec.Signal, framing: Framing, rate_control: RateControl | None = None, **given: float | str
) -> tuple[bytes, list[bytes]]:
    setting: Setting = slp.CODEC.complete(given)
    rms = tuple(float(np.sqrt(np.mean(channel**2))) or 1.0 for channel in signal.T)
    signal_format = SignalFormat(RATE_HZ, "full scale", (1.0,) * signal.shape[1], rms)
    encoder = slp.SlpEncoder(setting, signal_format, framing, None, rate_control)
    return encoder.configuration, encoder.encode(signal) + encoder.finish()


def decoded(configuration: bytes, packets: list[bytes], channels: int) -> codec.Decoded:
    return played(CoreDecoder(slp.NAME, configuration, channels), packets)


def difference_to_the_documented_decoder(configuration: bytes, packets: list[bytes], channels: int) -> float:
    reference = SlpReferenceDecoder(configuration, channels)
    return difference(reference, packets, decoded(configuration, packets, channels))


@pytest.mark.parametrize(("frame", "order", "channels"), [("32", 16, 1), ("64", 8, 3), ("128", 3, 1), ("64", 0, 2)])
def test_core_agrees_with_the_documented_decoder(frame: str, order: int, channels: int) -> None:
    configuration, packets = coded(texture(1500, channels), Framing(256, 3), frame=frame, order=order, shaping=0.4)
    assert difference_to_the_documented_decoder(configuration, packets, channels) < 1


@pytest.mark.parametrize("name", ["impulses", "full-scale square", "four-bit", "sweep", "onset"])
@pytest.mark.parametrize("quality", [2, slp.LEVELS - 1])
def test_core_agrees_with_the_documented_decoder_on_hard_signals(name: str, quality: int) -> None:
    configuration, packets = coded(edge_signals()[name][:1600], Framing(800, 0), quality=quality)
    assert difference_to_the_documented_decoder(configuration, packets, 1) < 1.5


@given(
    quantiser_offsets=st.lists(st.integers(-40, 40) | st.integers(-336, 336), min_size=1, max_size=8),
    frame=st.sampled_from(slp.FRAMES),
    contexts=st.sampled_from([slp.NEIGHBOURS, slp.BIN]),
    channels=st.integers(1, 2),
    refresh_packets=st.integers(0, 3),
)
@settings(max_examples=30, deadline=None)
def test_core_agrees_with_the_documented_decoder_on_any_quantiser_offsets(
    quantiser_offsets: list[int], frame: int, contexts: str, channels: int, refresh_packets: int
) -> None:
    signal, framing = texture(1500, channels), Framing(2 * frame, refresh_packets)
    configuration, packets = coded(signal, framing, in_turn(quantiser_offsets), frame=str(frame), contexts=contexts)
    assert difference_to_the_documented_decoder(configuration, packets, channels) < 1.5


def test_levels_rise_in_steps_of_about_a_decibel() -> None:
    signal = texture(5600)
    snrs_db = [
        codec.snr_db(signal, codec.encode(signal, RATE_HZ, rate_point, codec="slp").decode()) or 0.0
        for rate_point in slp.CODEC.rate_points
    ]
    assert len(snrs_db) >= 22
    assert snrs_db[0] < 5
    assert snrs_db[-1] > 30
    rises = np.diff(snrs_db)
    assert np.min(rises) > -0.3
    assert np.mean(rises) == pytest.approx(1.0, abs=0.3)


def test_shaping_moves_noise_to_where_less_is_felt() -> None:
    signal = texture(5600)
    noise_levels = []
    for shaping in (0.0, 1.0):
        stream = codec.encode(signal, RATE_HZ, {"quality": 16, "shaping": shaping}, codec="slp")
        spectrum = np.square(np.abs(np.fft.rfft((stream.decode() - signal)[:, 0])))
        frequencies_hz = np.fft.rfftfreq(len(signal), 1 / RATE_HZ)
        felt, barely = (np.mean(spectrum[(frequencies_hz > low) & (frequencies_hz < low + 100)]) for low in (200, 1000))
        noise_levels.append(felt / barely)
    assert noise_levels[1] < 0.5 * noise_levels[0]


@given(st.lists(st.integers(-15, 15), min_size=1, max_size=16))
@settings(max_examples=200)
def test_every_code_gives_a_stable_filter(codes: list[int]) -> None:
    """All codes that a decoder can read: reflection coefficients below 1, so all poles are inside the unit circle."""
    reflections = np.sin(np.array([codes]) * np.pi / 32)
    predictors = filters.predictors_of(reflections)
    back, unstable = slp.reflections_of(predictors)
    assert not np.any(unstable)
    np.testing.assert_allclose(back, reflections, atol=0.01)


@given(st.integers(0, 16), st.sampled_from([100, slp.STEP_CODES - 1]), st.binary(max_size=150))
@settings(max_examples=60)
def test_the_filter_of_any_stream_falls_silent(order: int, step_code: int, payload: bytes) -> None:
    """In the core's integers, from wherever any bytes drive it: packets without payload are silent frames."""
    decoder = CoreDecoder(slp.NAME, bytes((1 << 5 | order, 125, 0, 0, 90, step_code)), 1)
    decoder.decode(b"\x01" + payload)
    ringing = [decoder.decode(bytes((2 * sequence,))) for sequence in (1, 2)]
    assert not np.any(ringing[1])


def test_an_unstable_fit_is_mirrored_into_the_unit_circle() -> None:
    predictors = np.array([[2.2, -1.21 * 1.1], [0.5, 0.2]])
    reflections, unstable = slp.reflections_of(predictors)
    assert unstable.tolist() == [True, False]
    stable = filters.predictors_of(slp.stabilised(predictors))
    assert np.max(filters.pole_radii(stable)) < 1
    np.testing.assert_allclose(stable[1], predictors[1], atol=1e-9)
    np.testing.assert_allclose(filters.predictors_of(reflections[1:]), predictors[1:], atol=1e-9)


@given(
    st.lists(st.integers(-1024, 1024), min_size=1, max_size=400),
    st.integers(0, slp.LEVELS - 1),
    st.sampled_from(slp.FRAMES),
    st.integers(0, 16),
)
@settings(max_examples=60)
def test_any_signal_is_decoded_near_to_what_it_was(values: list[int], quality: int, frame: int, order: int) -> None:
    signal = np.array(values)[:, None] / 1024
    setting: Setting = {"quality": quality, "frame": str(frame), "order": order, "shaping": 0}
    result = codec.encode(signal, RATE_HZ, setting, codec="slp").decode()
    peak, rms = np.max(np.abs(signal)), np.sqrt(np.mean(signal**2))
    # Noise is at most that of steps of this size in the residual's spectrum, whatever the filter adds to it.
    noise_limit = 3 * slp.relative_step(quality) * rms + peak / 4096
    # The last frame is coded whole, so the noise of all its coefficients may meet the few samples that it has.
    coded_samples = math.ceil(len(signal) / frame) * frame
    assert np.sum((result - signal) ** 2) <= coded_samples * noise_limit**2


@pytest.mark.parametrize(
    "configuration",
    [
        b"",
        bytes(5),
        bytes((3 << 5, 1, 0, 0, 0, 0)),
        bytes((7 << 5, 1, 0, 0, 0, 0)),
        bytes((4 << 5 | 17, 1, 0, 0, 0, 0)),
        bytes((17, 1, 0, 0, 0, 0)),
        bytes((8, 0, 0, 0, 0, 0)),
        bytes((8, 0, 16, 0, 0, 0)),
        bytes((8, 1, 0, 0, 142, 0)),
        bytes((8, 1, 0, 0, 0, 168)),
        bytes((8, 1, 0, 0, 0, 0, 0)),
    ],
)
def test_configurations_out_of_range_are_rejected(configuration: bytes) -> None:
    with pytest.raises(CodecError, match="configuration"):
        CoreDecoder(slp.NAME, configuration, 1)
    assert len(CoreDecoder(slp.NAME, bytes((8, 255, 15, 0, 141, 167)), 1).conceal()) == 4095 * 32
