"""Policies: what a leaky bucket promises holds whatever sizes packets have; evenness, quality, real codecs."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vibrocast import codec
from vibrocast.codec import (
    CappedRate,
    CodecError,
    ConstantRate,
    Framing,
    Signal,
    SignalFormat,
    SnrMeter,
    TargetUnreachable,
    rate_control,
    rate_controlled_framing,
)
from vibrocast.codec.interface import Choice, Decoded, Trial
from vibrocast.codec.rate_control import RATE_BUFFER_S, added_bytes
from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.messages import SinglePacket, pack

RATE_HZ = 2800
SECONDS = 0.1
RATE_CONTROLLED = sorted(name for name, known in codec.CODECS.items() if known.controls_rate and not known.needs_model)


def fake_trial(sizes: tuple[int | None, ...], previous: int = 0) -> Trial:
    """Return a packet of the sizes given, from quantiser offset -3 on; None where it cannot be coded."""

    def code(quantiser_offset: int) -> bytes:
        size = sizes[quantiser_offset + 3]
        if size is None:
            raise CodecError("too long")
        return bytes((quantiser_offset & 0xFF,)) + bytes(size)

    return Trial(np.ones((round(SECONDS * RATE_HZ), 1)), range(-3, -3 + len(sizes)), previous, code)


class FakeDecoder:
    """Decodes what a fake trial coded: the coarser, the less of the samples."""

    channels, packet_samples, delay_samples, hosts_only = 1, round(SECONDS * RATE_HZ), 0, False

    def decode(self, packet: bytes) -> Decoded:
        quantiser_offset = (packet[0] ^ 0x80) - 0x80
        return np.full((self.packet_samples, 1), 32767 - 300 * (quantiser_offset + 3), np.int16)

    def conceal(self) -> Decoded:
        raise AssertionError("nothing is lost")


def begun(policy: codec.RatePolicy, min_bytes: int = 0) -> codec.RatePolicy:
    policy.begin(FakeDecoder(), min_bytes, SECONDS)
    return policy


def sent_bytes(trial: Trial, choice: Choice) -> int:
    size = max(len(trial.packet(choice.quantiser_offset)), choice.min_bytes)
    return size + added_bytes(bytes(size))


def ahead_of_rate(sizes: list[int], rate: float) -> NDArray[np.float64]:
    """Bytes sent before each packet and after the last, less what the rate would have sent."""
    return np.array([0, *itertools.accumulate(sizes)]) - np.arange(len(sizes) + 1) * rate * SECONDS / 8


# The coarsest fits into every rate here; the others are as they come.
packets = st.lists(
    st.lists(st.none() | st.integers(0, 400), max_size=40).map(lambda sizes: fake_trial((*sizes, 1))),
    min_size=1,
    max_size=30,
)
rates = st.floats(900, 20_000)


@given(packets, rates)
def test_over_any_run_a_constant_rate_has_its_bytes(trials: list[Trial], rate: float) -> None:
    policy = begun(ConstantRate(rate))
    sizes = [sent_bytes(trial, policy(trial)) for trial in trials]
    assert np.ptp(ahead_of_rate(sizes, rate)) <= max(1, rate * RATE_BUFFER_S / 8) + 1e-6


@given(packets, rates, st.floats(0, 60))
def test_over_any_run_a_capped_rate_is_not_exceeded(trials: list[Trial], rate: float, quality_db: float) -> None:
    policy = begun(CappedRate(quality_db, SnrMeter(RATE_HZ), rate))
    ahead = ahead_of_rate([sent_bytes(trial, policy(trial)) for trial in trials], rate)
    max_ahead = np.maximum.accumulate(ahead[::-1])[::-1] - ahead
    assert np.max(max_ahead) <= max(1, rate * RATE_BUFFER_S / 8) + 1e-6


@given(packets, rates, rates)
def test_a_rate_that_changes_counts_again_when_the_rate_buffer_has_drained(
    trials: list[Trial], before: float, after: float
) -> None:
    policy = ConstantRate(before)
    begun(policy)
    for trial in trials:
        policy(trial)
    policy.bits_per_second = after
    empty = fake_trial((1,))
    while policy.rate_buffer.full > 1:
        policy(empty)
    sizes = [sent_bytes(trial, policy(trial)) for trial in trials]
    assert np.ptp(ahead_of_rate(sizes, after)) <= policy.rate_buffer.size_bytes + 1e-6


@given(st.binary(max_size=600))
def test_policies_count_the_bytes_of_a_frame(packet: bytes) -> None:
    assert len(packet) + added_bytes(packet) == len(write_frame(pack(SinglePacket(0, packet))))


def test_the_finest_that_fits_is_found_in_few_trials() -> None:
    tried = []

    whole = fake_trial(tuple(range(500, 0, -1)), previous=100)

    def counted(quantiser_offset: int) -> bytes:
        tried.append(quantiser_offset)
        return whole.code(quantiser_offset)

    trial = replace(whole, code=counted)
    choice = begun(ConstantRate(20_000))(trial)
    assert abs(sent_bytes(trial, choice) - 250) <= 1
    assert choice.min_bytes == len(trial.packet(choice.quantiser_offset))
    assert len(set(tried)) < 20


def test_a_rate_below_the_coarsest_packets_is_rejected_with_the_least() -> None:
    with pytest.raises(
        TargetUnreachable, match=r"500 bit/s cannot be held: packets of 100\.0 ms .* at least 800 bit/s; .* longer pack"
    ):
        begun(ConstantRate(500), min_bytes=10)
    policy = ConstantRate(900)
    begun(policy, min_bytes=10)
    with pytest.raises(TargetUnreachable, match="800 bit/s"):
        policy.bits_per_second = 799
    policy.bits_per_second = 801
    with pytest.raises(TargetUnreachable, match=r"packets of 100\.0 ms .* at least 4560 bit/s"):
        policy(fake_trial((60, 50)))


@pytest.mark.parametrize("rate", [0, -1, math.nan, math.inf])
def test_what_is_no_rate_is_rejected(rate: float) -> None:
    with pytest.raises(CodecError, match="ask for a positive number"):
        ConstantRate(rate)


def texture(seconds: float, seed: int = 0, channels: int = 1) -> Signal:
    """Return coloured noise that swells by 6 dB and falls again, once a second."""
    noise = np.random.default_rng(seed).standard_normal((round(seconds * RATE_HZ), channels))
    swell = 0.05 * (1.5 + 0.5 * np.sin(2 * np.pi * np.arange(len(noise)) / RATE_HZ))
    coloured: Signal = swell[:, None] * np.cumsum(noise - np.roll(noise, 9, axis=0), axis=0) / 9
    return coloured


def hostile(channels: int) -> Signal:
    """Texture, silence, clicks 60 dB above the texture, full-scale noise, full-scale direct current, texture."""
    calm, loud = 1e-3 * texture(3, 1, channels), np.random.default_rng(2).uniform(-1, 1, (4000, channels))
    clicks = calm.copy()
    clicks[::700] = 1.0
    return np.concatenate([calm, np.zeros((6000, channels)), clicks, loud, np.ones((4000, channels)), calm])


def worst_deviation(sizes: list[int], rate: float, seconds: float) -> float:
    """Return by how much any run of packets of at least 2 s differs from the rate."""
    run = math.ceil(2 / seconds)
    sums = np.convolve(sizes, np.ones(run), "valid")
    return float(np.max(np.abs(sums / (rate * run * seconds / 8) - 1)))


@pytest.mark.parametrize("name", RATE_CONTROLLED)
@pytest.mark.parametrize(("rate_per_channel", "channels"), [(500, 1), (1000, 4), (20_000, 2)])
def test_every_codec_that_controls_rate_holds_its_rate_whatever_comes(
    name: str, rate_per_channel: int, channels: int
) -> None:
    samples, rate = hostile(channels), rate_per_channel * channels
    framing = rate_controlled_framing(rate, RATE_HZ)
    try:
        source = codec.Source.of(samples, RATE_HZ, codec=name, live=True)
        coded = codec.encode_rate_controlled(source, {}, ConstantRate(rate), framing)
    except TargetUnreachable as rejected:
        assert f"{rate} bit/s cannot be held" in str(rejected)
        assert "longer packets" in str(rejected)
        return
    sizes = [len(packet) + added_bytes(packet) for packet in coded.packets]
    assert worst_deviation(sizes, rate, coded.packet_samples / RATE_HZ) < 0.01
    assert coded.decode().shape == samples.shape


def packet_snrs_db(samples: Signal, coded: codec.Stream) -> NDArray[np.float64]:
    size, delay = coded.packet_samples, coded.delay_samples
    late = np.concatenate([np.zeros((delay, coded.header.channels)), samples])
    decoded = coded.decode_integers() * np.array(coded.header.gains) / 32768
    count = len(late) // size
    power, error = (
        np.mean(np.square(each[: count * size].reshape(count, -1)), axis=1)
        for each in (late, late - decoded[: len(late)])
    )
    ratios: NDArray[np.float64] = 10 * np.log10(power / error)
    return ratios


@pytest.mark.parametrize("name", ["mdct", "slp"])
def test_every_packet_has_the_quality_where_the_rate_suffices_and_no_more_bytes_elsewhere(name: str) -> None:
    samples, framing = texture(3), Framing(160, 20)
    source = codec.Source.of(samples, RATE_HZ, codec=name, live=True)
    roomy, tight = (
        codec.encode_rate_controlled(source, {}, CappedRate(15, SnrMeter(RATE_HZ), rate_bps), framing)
        for rate_bps in (100_000, 2300)
    )
    ratios = packet_snrs_db(samples, roomy)[2:]
    assert np.min(ratios) >= 14.99
    assert np.percentile(ratios, 90) < 16
    packet_samples = codec.decoder(codec.codec_by_name(name).identifier, tight.header.configuration, 1).packet_samples
    assert max(map(len, tight.packets)) <= 2300 * (packet_samples / RATE_HZ + 0.018) / 8
    assert np.mean(packet_snrs_db(samples, tight)) < 14


def test_a_rate_whose_packets_last_over_two_seconds_is_rejected() -> None:
    with pytest.raises(TargetUnreachable, match=r"20 bit/s cannot be held over 2 s.*choose 264 bit/s"):
        rate_controlled_framing(20, RATE_HZ)


@pytest.mark.parametrize("name", ["mdct", "slp"])
def test_packets_that_no_frame_carries_are_not_chosen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Packets of the finest steps, which the search may test, have more bytes than a frame."""

    def frame_bytes(packet: bytes) -> int:
        if len(packet) > 300:
            raise CodecError("no frame carries it")
        return 6

    monkeypatch.setattr(rate_control, "added_bytes", frame_bytes)
    for policy in (ConstantRate(800), CappedRate(90, SnrMeter(RATE_HZ), 100_000)):
        source = codec.Source.of(texture(4), RATE_HZ, codec=name, live=True)
        coded = codec.encode_rate_controlled(source, {}, policy, Framing(RATE_HZ, 2))
        assert max(map(len, coded.packets)) <= 300


@pytest.mark.parametrize("name", ["dct", "mdct", "slp"])
def test_the_coarsest_packet_is_short_whatever_came_before(name: str) -> None:
    """A loud signal that stops, after packets at the stream's own quality, which entropy coders have become used to."""
    time_s = np.arange(4 * RATE_HZ) / RATE_HZ
    signal = np.sign(np.sin(2 * np.pi * 11.0 * time_s))[:, None] * (time_s < 3.7)[:, None]
    coarsest: list[int] = []

    def steer(trial: Trial) -> Choice:
        coarsest.append(len(trial.packet(trial.quantiser_offsets[-1])))
        return Choice(0)

    known, signal_format = codec.codec_by_name(name), SignalFormat(RATE_HZ, "um", (1.0,), (0.28,))
    known.make_encoder(known.complete({}), signal_format, Framing(1400, 0), None, steer).encode(signal)
    assert len(coarsest) > 5
    assert max(coarsest) < 24
