"""Policies: what a leaky bucket promises holds whatever sizes packets have; evenness, quality, groups, real codecs."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import codec
from codec import (
    CappedRate,
    CodecError,
    ConstantRate,
    Group,
    OutOfReach,
    Signal,
    SnrJudge,
    steered_framing,
)
from codec.interface import Choice, Decoded

RATE_HZ = 2800
SECONDS = 0.1
FRAME_BYTES = 8
STEERED = sorted(name for name, known in codec.CODECS.items() if known.steers and not known.needs_model)


@dataclass(frozen=True)
class FakeTrial:
    """A packet of the sizes given, from coarseness -3 on; None where it cannot be coded."""

    sizes: tuple[int | None, ...]
    previous: int = 0

    @property
    def samples(self) -> Signal:
        return np.ones((round(SECONDS * RATE_HZ), 1))

    @property
    def coarsenesses(self) -> range:
        return range(-3, -3 + len(self.sizes))

    def packet(self, coarseness: int) -> bytes:
        size = self.sizes[coarseness + 3]
        if size is None:
            raise CodecError("too long")
        return bytes((coarseness & 0xFF,)) + bytes(size)


class FakeDecoder:
    """Decodes what a FakeTrial coded: the coarser, the less of the samples."""

    channels, packet_samples, delay_samples = 1, round(SECONDS * RATE_HZ), 0

    def decode(self, packet: bytes) -> Decoded:
        coarseness = (packet[0] ^ 0x80) - 0x80
        return np.full((self.packet_samples, 1), 32767 - 300 * (coarseness + 3), np.int16)

    def conceal(self) -> Decoded:
        raise AssertionError("nothing is lost")

    def copy(self) -> "FakeDecoder":
        return self


def begun(policy: codec.Policy, least_bytes: int = 0) -> codec.Policy:
    policy.begin(FakeDecoder(), least_bytes, SECONDS)
    return policy


def sent_bytes(trial: FakeTrial, choice: Choice) -> int:
    return max(len(trial.packet(choice.coarseness)), choice.least_bytes) + FRAME_BYTES


def ahead_of_rate(sizes: list[int], rate: float) -> NDArray[np.float64]:
    """Bytes sent before each packet and after the last, less what the rate would have sent."""
    return np.array([0, *itertools.accumulate(sizes)]) - np.arange(len(sizes) + 1) * rate * SECONDS / 8


# The coarsest fits into every rate here; the others are as they come.
packets = st.lists(
    st.lists(st.none() | st.integers(0, 400), max_size=40).map(lambda sizes: FakeTrial((*sizes, 1))),
    min_size=1,
    max_size=30,
)
rates = st.floats(900, 20_000)
buckets_s = st.floats(0.001, 2)


@given(packets, rates, buckets_s, st.booleans())
def test_over_any_run_a_constant_rate_has_its_bytes(
    trials: list[FakeTrial], rate: float, bucket_s: float, judged: bool
) -> None:
    policy = begun(ConstantRate(rate, FRAME_BYTES, bucket_s, SnrJudge(RATE_HZ) if judged else None))
    sizes = [sent_bytes(trial, policy(trial)) for trial in trials]
    assert np.ptp(ahead_of_rate(sizes, rate)) <= max(1, rate * bucket_s / 8) + 1e-6


@given(packets, rates, buckets_s, st.floats(0, 60))
def test_over_any_run_a_capped_rate_is_not_exceeded(
    trials: list[FakeTrial], rate: float, bucket_s: float, quality_db: float
) -> None:
    policy = begun(CappedRate(quality_db, SnrJudge(RATE_HZ), rate, FRAME_BYTES, bucket_s))
    ahead = ahead_of_rate([sent_bytes(trial, policy(trial)) for trial in trials], rate)
    most_ahead = np.maximum.accumulate(ahead[::-1])[::-1] - ahead
    assert np.max(most_ahead) <= max(1, rate * bucket_s / 8) + 1e-6


@given(packets, rates, rates)
def test_a_rate_that_changes_counts_anew_when_the_bucket_has_drained(
    trials: list[FakeTrial], before: float, after: float
) -> None:
    policy = ConstantRate(before, FRAME_BYTES)
    begun(policy)
    for trial in trials:
        policy(trial)
    policy.bits_per_second = after
    empty = FakeTrial((1,))
    while policy.bucket.full > 1:
        policy(empty)
    sizes = [sent_bytes(trial, policy(trial)) for trial in trials]
    assert np.ptp(ahead_of_rate(sizes, after)) <= policy.bucket.size_bytes + 1e-6


@given(st.lists(packets, min_size=1, max_size=4), rates)
def test_what_a_group_sends_is_one_constant_rate(streams: list[list[FakeTrial]], rate: float) -> None:
    rate *= len(streams)
    group = Group(ConstantRate(rate, FRAME_BYTES), len(streams))
    sizes = []

    def coder(policy: codec.Policy) -> Callable[[Signal], list[bytes]]:
        def code(samples: Signal) -> list[bytes]:
            trial = next(coming)
            return [bytes(sent_bytes(trial, policy(trial)))]

        return code

    for member in group.members:
        begun(member)
    coders = [coder(member) for member in group.members]
    for trials in zip(*streams, strict=False):
        coming = iter(trials)
        coded = group.code(coders, [np.zeros((1, 1))] * len(streams))
        sizes.append(sum(len(packet) for (packet,) in coded))
    assert np.ptp(ahead_of_rate(sizes, rate)) <= max(1, rate * 0.018 / 8) + 1e-6


def test_the_finest_that_fits_is_found_in_few_trials() -> None:
    tried = []

    class Counting(FakeTrial):
        def packet(self, coarseness: int) -> bytes:
            tried.append(coarseness)
            return super().packet(coarseness)

    trial = Counting(tuple(range(500, 0, -1)), previous=100)
    choice = begun(ConstantRate(20_000))(trial)
    assert abs(len(trial.packet(choice.coarseness)) - 250) <= 1
    assert choice.least_bytes == len(trial.packet(choice.coarseness))
    assert len(set(tried)) < 20


def test_a_rate_below_the_coarsest_packets_is_refused_with_the_least() -> None:
    with pytest.raises(
        OutOfReach, match=r"500 bit/s cannot be held: packets of 100\.0 ms take 800 bit/s .* longer pack"
    ):
        begun(ConstantRate(500), least_bytes=10)
    policy = ConstantRate(900)
    begun(policy, least_bytes=10)
    with pytest.raises(OutOfReach, match="800 bit/s"):
        policy.bits_per_second = 799
    policy.bits_per_second = 801
    with pytest.raises(OutOfReach, match=r"packets of 100\.0 ms take 4080 bit/s"):
        policy(FakeTrial((60, 50)))


@pytest.mark.parametrize("rate", [0, -1, math.nan, math.inf])
def test_what_is_no_rate_is_refused(rate: float) -> None:
    with pytest.raises(CodecError, match="ask for a positive number"):
        ConstantRate(rate)
    with pytest.raises(CodecError, match="must hold a positive time"):
        ConstantRate(1000, bucket_s=rate)


def test_a_packet_that_cannot_be_coded_says_so() -> None:
    with pytest.raises(CodecError, match="too long"):
        begun(ConstantRate(1000))(FakeTrial((None, None)))


def texture(seconds: float, seed: int = 0, channels: int = 1) -> Signal:
    noise = np.random.default_rng(seed).standard_normal((round(seconds * RATE_HZ), channels))
    return (
        0.1
        * np.sin(np.arange(len(noise)) / 900)[:, None] ** 2
        * np.cumsum(noise - np.roll(noise, 9, axis=0), axis=0)
        / 9
    )


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


@pytest.mark.parametrize("name", STEERED)
@pytest.mark.parametrize(("rate_per_channel", "channels"), [(500, 1), (1000, 4), (20_000, 2)])
def test_every_codec_that_steers_holds_its_rate_whatever_comes(name: str, rate_per_channel: int, channels: int) -> None:
    samples, rate = hostile(channels), rate_per_channel * channels
    framing = steered_framing(rate, RATE_HZ, lambda packet: FRAME_BYTES)
    try:
        coded = codec.encode_steered(samples, RATE_HZ, ConstantRate(rate, FRAME_BYTES), framing, codec=name)
    except OutOfReach as refused:
        assert f"{rate} bit/s cannot be held" in str(refused)
        assert "longer packets" in str(refused)
        return
    packet_samples = codec.decoder(codec.codec_by_name(name).identifier, coded.configuration, channels).packet_samples
    sizes = [len(packet) + FRAME_BYTES for packet in coded.packets]
    assert worst_deviation(sizes, rate, packet_samples / RATE_HZ) < 0.01
    assert codec.decode(coded).shape == samples.shape
