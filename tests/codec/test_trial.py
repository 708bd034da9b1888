"""Duties of every codec with rate control: trials from one state, packets as chosen, padding, same samples."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.codec.signals import RATE_HZ, texture
from tests.codec.test_every_codec import middle_setting, model_of, tables_of
from vibrocast import codec
from vibrocast.codec import CodecError, Signal
from vibrocast.codec.interface import Choice, Encoder, RateControl, Trial
from vibrocast.codec.mdct import hop_samples

RATE_CONTROLLED = [name for name, known in codec.CODECS.items() if known.controls_rate]
every_rate_controlled_codec = pytest.mark.parametrize("name", RATE_CONTROLLED)
FRAMING = codec.Framing(4 * hop_samples(RATE_HZ), 5)


def encoder_of(name: str, signal: Signal, rate_control: RateControl | None) -> Encoder:
    rms = tuple(float(np.sqrt(np.mean(channel**2))) or 1.0 for channel in signal.T)
    signal_format = codec.SignalFormat(RATE_HZ, "full scale", (1.0,) * signal.shape[1], rms)
    setting = codec.CODECS[name].complete(middle_setting(name))
    return codec.CODECS[name].make_encoder(setting, signal_format, FRAMING, model_of(name), rate_control)


def coded(name: str, signal: Signal, rate_control: RateControl) -> tuple[Encoder, list[bytes]]:
    encoder = encoder_of(name, signal, rate_control)
    return encoder, encoder.encode(signal) + encoder.finish()


def decoded(name: str, encoder: Encoder, packets: list[bytes], channels: int) -> codec.Decoded:
    identifier = codec.CODECS[name].identifier
    decoder = codec.decoder(identifier, encoder.configuration, channels, tables_of(name))
    return np.concatenate([decoder.decode(packet) for packet in packets])


def in_turn(places: list[int], min_bytes: int = 0) -> RateControl:
    """Choose the quantiser offsets at these places, in 1/64 of all that can be chosen, one after the other."""
    count = 0

    def rate_control(trial: Trial) -> Choice:
        nonlocal count
        count += 1
        place = places[count % len(places)] * (len(trial.quantiser_offsets) - 1) // 64
        return Choice(trial.quantiser_offsets[place], min_bytes)

    return rate_control


@every_rate_controlled_codec
def test_trials_change_no_state_and_equal_the_coded_packet(name: str) -> None:
    signal = texture(2000, 2)
    choose = in_turn([20, 25, 40, 22])
    packets: list[bytes] = []
    previous = 0

    def rate_control(trial: Trial) -> Choice:
        nonlocal previous
        assert trial.previous == previous
        choice = choose(trial)
        sizes = [len(trial.packet(quantiser_offset)) for quantiser_offset in trial.quantiser_offsets[::40]]
        assert sizes[-1] <= sizes[0]
        packets.append(trial.packet(choice.quantiser_offset))
        previous = choice.quantiser_offset
        return choice

    assert coded(name, signal, rate_control)[1] == packets
    assert coded(name, signal, in_turn([20, 25, 40, 22]))[1] == packets


@every_rate_controlled_codec
def test_coarser_takes_fewer_bytes_and_errs_more(name: str) -> None:
    signal = texture(2800)
    results = []
    for place in range(0, 65, 8):
        encoder, packets = coded(name, signal, in_turn([place]))
        heard = decoded(name, encoder, packets, 1)[encoder.delay_samples :][: len(signal)] / 32768
        results.append((sum(map(len, packets)), float(np.sqrt(np.mean((heard - signal) ** 2)))))
    sizes, errors = np.array(results).T
    assert np.all(np.diff(sizes) <= 0.02 * sizes[:-1])
    assert sizes[-1] < 0.5 * sizes[0]
    assert errors[-1] > 3 * errors[0]


@every_rate_controlled_codec
def test_the_samples_of_a_trial_are_what_its_packet_stands_for(name: str) -> None:
    wanted: list[Signal] = []

    def finest(trial: Trial) -> Choice:
        wanted.append(trial.samples)
        return Choice(trial.quantiser_offsets[0])

    signal = texture(2000, 2)
    encoder, packets = coded(name, signal, finest)
    assert {part.shape for part in wanted} == {(encoder.packet_samples, 2)}
    heard = decoded(name, encoder, packets, 2) / 32768
    expected = np.concatenate(wanted)
    assert (codec.snr_db(expected[:2000], heard[:2000]) or 0) > 5
    delayed = np.concatenate([np.zeros((encoder.delay_samples, 2)), signal])
    np.testing.assert_allclose(expected[: len(delayed)], delayed[: len(expected)], atol=1e-3)


@every_rate_controlled_codec
@given(places=st.lists(st.integers(0, 64), min_size=1, max_size=6), padding=st.integers(0, 300))
@settings(max_examples=6)
def test_padding_changes_nothing_but_the_length(name: str, places: list[int], padding: int) -> None:
    signal = texture(900, 2)
    encoder, packets = coded(name, signal, in_turn(places))
    _, padded = coded(name, signal, in_turn(places, padding))
    assert [len(packet) for packet in padded] == [max(len(packet), padding) for packet in packets]
    assert all(long.rstrip(b"\0") == short.rstrip(b"\0") for long, short in zip(padded, packets, strict=True))
    np.testing.assert_array_equal(decoded(name, encoder, padded, 2), decoded(name, encoder, packets, 2))


@every_rate_controlled_codec
@pytest.mark.parametrize(
    "choose",
    [
        lambda trial: Choice(trial.quantiser_offsets[0] - 1),
        lambda trial: Choice(trial.quantiser_offsets[-1] + 1),
        lambda trial: Choice(0, 65_536),
        lambda trial: Choice(0, len(trial.packet(trial.quantiser_offsets[-1] + 1))),
    ],
)
def test_choices_that_no_packet_can_have_are_rejected(name: str, choose: Callable[[Trial], Choice]) -> None:
    with pytest.raises(CodecError, match=r"it must choose|; choose"):
        coded(name, texture(1000), choose)


@pytest.mark.parametrize("name", [name for name in codec.CODECS if name not in RATE_CONTROLLED])
def test_codecs_that_have_no_rate_control_say_so(name: str) -> None:
    with pytest.raises(CodecError, match="one quality; choose"):
        encoder_of(name, texture(100), in_turn([0]))


@every_rate_controlled_codec
def test_the_configuration_says_whether_a_stream_is_rate_controlled(name: str) -> None:
    signal = texture(300)
    plain, rate_controlled = encoder_of(name, signal, None), encoder_of(name, signal, in_turn([0]))
    assert plain.configuration != rate_controlled.configuration
    assert len(plain.configuration) <= len(rate_controlled.configuration) <= len(plain.configuration) + 1
