"""Profiles under a hand: spectra at every speed, reversals, lost and late and hostile positions; the controller."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.simulated_device.bench import SMALL, Bench, Stream
from vibrocast import codec
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT, StreamHeader
from vibrocast.device_protocol.messages import (
    Loop,
    Message,
    Pause,
    Position,
    Resume,
    Start,
    State,
    Stop,
    StreamData,
    pack,
)
from vibrocast.output.actuator import LRA, PIEZO_STACK, Actuator
from vibrocast.output.profile import (
    HAND_DELAY_US,
    HAND_SMOOTHING_US,
    Profile,
    min_samples,
    render,
)

SAMPLES_PER_METRE = 100_000
SAMPLES = 2048
RATE_HZ = 3000
DELAY_S = (HAND_DELAY_US + 2 * HAND_SMOOTHING_US) / 1e6
# The promise: exact up to this part of the DAC's rate and of the profile's own.
EXACT, EXACT_OF_PROFILE = 0.15, 0.34
BETWEEN_POSITIONS_S = 0.01
Way = Callable[[float], float]
"""Where the hand is, in mm, at a time in s."""


@cache
def heights(samples: int = SAMPLES) -> NDArray[np.int16]:
    """A rough profile, int16 (samples,), of all that may be rendered exactly; its end meets its beginning."""
    spectrum = np.fft.rfft(np.random.default_rng(1).standard_normal(samples))
    spectrum[np.fft.rfftfreq(samples) > EXACT_OF_PROFILE] = 0
    rough = np.fft.irfft(spectrum, samples)
    made: NDArray[np.int16] = np.round(20_000 * rough / np.abs(rough).max()).astype(np.int16)
    return made


def loaded(profile: NDArray[np.int16], dac_rate_hz: int = RATE_HZ) -> Profile:
    rendered = Profile(SAMPLES_PER_METRE, len(profile), 1, dac_rate_hz)
    rendered.load(profile[:, None])
    return rendered


def exact(profile: NDArray[np.int16], places_mm: NDArray[np.float64], highest: float) -> NDArray[np.float64]:
    """Return a repeated profile at any places, its frequencies up to `highest` per sample, by its Fourier series."""
    spectrum = np.fft.rfft(profile) / len(profile)
    phase = 2j * np.pi * (places_mm / 1000 * SAMPLES_PER_METRE) / len(profile)
    value = np.full(len(places_mm), spectrum[0].real)
    for k in range(1, min(len(spectrum), int(highest * len(profile)) + 1)):
        value += 2 * (spectrum[k] * np.exp(k * phase)).real
    return value


def rendered_along(profile: Profile, way: Way, seconds: float, dac_rate_hz: int = RATE_HZ) -> NDArray[np.int16]:
    """Return the heights (n,) under a hand whose position comes every BETWEEN_POSITIONS_S."""
    came, made = 0, []
    for number in range(round(seconds * dac_rate_hz)):
        time_us = number * 1_000_000 // dac_rate_hz
        while came * BETWEEN_POSITIONS_S * 1e6 <= time_us:
            at_s = came * BETWEEN_POSITIONS_S
            profile.position(round(1e6 * at_s), round(1e6 * way(at_s)))
            came += 1
        made.append(profile.render([max(0, time_us - HAND_DELAY_US)])[0, 0])
    return np.array(made)


def snr_db(made: NDArray[np.int16], expected: NDArray[np.float64]) -> float:
    """Compare within the band; what is above it is not exact, and leaks a little into it."""
    window = np.blackman(len(expected))
    inside = np.fft.rfftfreq(len(expected)) < 0.95 * EXACT
    error, signal = (np.fft.rfft(values * window)[inside] for values in (made - expected, expected))
    return float(10 * np.log10(np.sum(np.abs(signal) ** 2) / np.sum(np.abs(error) ** 2)))


@pytest.mark.parametrize("dac_rate_hz", [3000, 8000])
@pytest.mark.parametrize("speed_mm_s", [1, 5, 20, 50, 100, 200, 300, -120])
def test_constant_speed_gives_the_profile_exactly_within_the_band(speed_mm_s: int, dac_rate_hz: int) -> None:
    seconds, settled_s = 0.6, 0.2
    made = rendered_along(loaded(heights(), dac_rate_hz), lambda t: speed_mm_s * t + 0.123, seconds, dac_rate_hz)
    first = round(settled_s * dac_rate_hz)
    time_s = np.arange(first, len(made)) / dac_rate_hz
    places_mm = speed_mm_s * (time_s - DELAY_S) + 0.123
    per_sample = abs(speed_mm_s) / 1000 * SAMPLES_PER_METRE / dac_rate_hz
    assert snr_db(made[first:], exact(heights(), places_mm, EXACT / per_sample)) > 50


@pytest.mark.parametrize(("samples", "left_out"), [(32, 0), (32, 31), (64, 2), (96, 4), (544, 31)])
def test_profile_repeats_as_it_is(samples: int, left_out: int) -> None:
    """From the shortest one on, shorter than the reach of the interpolator in the coarser octaves."""
    assert samples % min_samples(SAMPLES_PER_METRE, RATE_HZ) == 0
    profile, speed_mm_s = heights(samples), 50
    longer = np.append(profile, np.full(left_out, 9999, np.int16))
    made = rendered_along(loaded(longer), lambda t: speed_mm_s * t, 0.5)[600:]
    time_s = np.arange(600, 600 + len(made)) / RATE_HZ
    highest = EXACT * RATE_HZ / (speed_mm_s / 1000 * SAMPLES_PER_METRE)
    assert snr_db(made, exact(profile, speed_mm_s * (time_s - DELAY_S), highest)) > 50


@pytest.mark.parametrize("per_dac_sample", [0.53, 0.7, 1.01, 1.9, 3.3])
@pytest.mark.parametrize("speed_mm_s", [37, 110, 300])
def test_nothing_is_aliased(per_dac_sample: float, speed_mm_s: int) -> None:
    """A grating that a hand passes faster than half the DAC's rate leaves nothing."""
    per_sample = per_dac_sample * RATE_HZ / (speed_mm_s / 1000 * SAMPLES_PER_METRE)
    if per_sample > 0.43:
        pytest.skip("finer than the profile's band")
    grating = 20_000 * np.sin(2 * np.pi * round(per_sample * SAMPLES) * np.arange(SAMPLES) / SAMPLES)
    made = rendered_along(loaded(np.round(grating).astype(np.int16)), lambda t: speed_mm_s * t, 0.4)[600:]
    assert 20 * np.log10(max(1.0, float(np.std(made))) / np.std(grating)) < -50


@cache
def steepest() -> float:
    """Return the steepest slope of the profile, per mm."""
    return float(np.abs(np.diff(exact(heights(), np.arange(0, 18, 0.002), 0.5))).max() / 0.002)


def max_step(speed_mm_s: float) -> float:
    """Return the largest step from one DAC sample to the next that the profile gives a hand at up to this speed."""
    return steepest() * speed_mm_s / RATE_HZ


@pytest.mark.parametrize(
    ("way", "fastest_mm_s"),
    [
        (lambda t: 40 * abs(t - 0.3), 40),
        (lambda t: 10 * np.sin(8 * t), 80),
        (lambda t: 60 * min(t, 0.25) + 60 * max(0.0, t - 0.4), 60),
    ],
    ids=["reversal", "strokes", "stop and go"],
)
def test_no_step_is_larger_than_the_texture_has_at_that_speed(way: Way, fastest_mm_s: float) -> None:
    made = rendered_along(loaded(heights()), way, 0.8)[150:].astype(int)
    assert np.abs(np.diff(made)).max() <= 1.02 * max_step(fastest_mm_s) + 2


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=6, deadline=None)
def test_jitter_and_loss_make_no_step(seed: int) -> None:
    """Up to 30 % of positions are lost and the rest come late, of a hand at 50 mm/s that turns back."""
    chance, profile = np.random.default_rng(seed), loaded(heights())
    sent_us = [number * 5000 for number in range(120) if chance.random() > 0.3]
    coming = sorted((time_us + round(30_000 * chance.random()), time_us) for time_us in sent_us)
    made = []
    for number in range(2400):
        time_us = number * 1_000_000 // RATE_HZ
        while coming and coming[0][0] <= time_us:
            hand_us = coming.pop(0)[1]
            profile.position(hand_us, round(50e6 * abs(hand_us / 1e6 - 0.3)))
        made.append(int(profile.render([max(0, time_us - HAND_DELAY_US)])[0, 0]))
    # A gap is caught up with faster than the hand goes, and no faster than 600 mm/s.
    assert np.abs(np.diff(made[150:])).max() <= 1.1 * max_step(300)
    assert made[-1] == made[-100], "the hand has come to rest"


def test_hand_beyond_all_speeds_and_its_jumps_are_faded_out() -> None:
    profile = loaded(heights())
    made = rendered_along(profile, lambda t: 800.0 * t, 0.5)
    assert not made[600:].any()
    jumped = rendered_along(loaded(heights()), lambda t: 3.0 if t < 0.3 else 900.0, 0.8)
    assert np.abs(np.diff(jumped[150:].astype(int))).max() <= max_step(600)  # until it has faded out
    expected = exact(heights(), np.array([900.0]), 0.5)[0]
    assert jumped[-1] == pytest.approx(expected, abs=20)


any_position = st.tuples(
    st.integers(0, 2**64 - 1) | st.integers(0, 200_000), st.integers(-(2**63), 2**63 - 1) | st.integers(-(10**7), 10**7)
)


@given(st.lists(st.one_of(any_position, st.integers(1, 60)), max_size=60))
@settings(max_examples=40, deadline=None)
def test_any_positions_are_rendered_within_the_profile(steps: list[tuple[int, int] | int]) -> None:
    profile, time_us, made = loaded(heights()), 0, []
    for step in steps:
        if isinstance(step, tuple):
            profile.position(*step)
            continue
        for _ in range(step):
            time_us += 333
            made.append(int(profile.render([time_us])[0, 0]))
    highest = int(np.abs(heights().astype(int)).max())
    assert all(abs(height) <= 1.3 * highest for height in made)
    # A step of the hand's 600 mm/s, or of the fade.
    assert np.abs(np.diff([0, *made])).max(initial=0) <= max_step(600) + 1.3 * highest / (0.02 * RATE_HZ) + 2


# ---- controllers ----


@cache
def coded(channels: int = 1) -> Stream:
    """A profile coded in several packets."""
    columns = np.stack([np.roll(heights(), 100 * channel) for channel in range(channels)], axis=1) / 4000
    made = codec.encode(columns, SAMPLES_PER_METRE, {"step": 0.05}, live=True)
    header = StreamHeader(1, SAMPLES_PER_METRE, SAMPLES, PROFILE_UNIT, made.header.gains, made.header.configuration)
    decoder = codec.decoder(1, made.header.configuration, channels)
    decoded = made.decode_integers()
    return Stream(header, made.packets, decoded, decoder.packet_samples, decoder.delay_samples)


BOARD = replace(SMALL, watchdog_ms=1000)


def test_controller_puts_out_what_is_computed() -> None:
    """Over loss of packets, a stroke, and positions that come with jitter."""
    stream, chance = coded(2), np.random.default_rng(3)
    bench = Bench(BOARD)
    bench.configure(stream)
    bench.send(stream, range(1, len(stream.packets)))
    bench.ask(Start(50_000))
    assert bench.status().position == 0
    bench.send(stream, range(len(stream.packets)))
    assert bench.status().position == len(stream.packets) * stream.packet_samples
    hand = [(0, 1_000_000)]
    bench.send_payload(pack(Position(*hand[0])))
    # Sent at 0, it is taken for the moment when it came.
    hand = [(bench.now_us, 1_000_000)]
    for _ in range(60):
        bench.run(int(chance.integers(3, 9)), polling=False)
        hand.append((bench.now_us - int(chance.integers(0, 1500)), round(1e6 + 20e6 * np.sin(bench.now_us / 1e5))))
        bench.send_payload(pack(Position(*hand[-1])))
    codes = bench.all_codes()
    _, expected = render(
        stream.header, stream.decoded, stream.delay_samples, hand, len(codes), PIEZO_STACK, start_us=50_000
    )
    assert len(codes) > 500
    np.testing.assert_array_equal(codes, expected)
    bench.ask(Stop())
    assert bench.status().state == State.STOPPED
    bench.run(20)
    assert not bench.all_codes()[-1].any()


def test_positions_out_of_turn_are_counted() -> None:
    bench = Bench(BOARD)
    bench.start_all(coded())
    bench.run(1)
    now_us = bench.status().device_time_us
    for time_us in (now_us - 20, now_us - 10, now_us - 10, now_us - 20, now_us + 10**6, now_us + 10**6 + 1, 0, 0):
        bench.send_payload(pack(Position(time_us, 0)))
    assert (bench.status().repeated_frames, bench.status().reordered_frames) == (1, 1)


def test_sensor_on_the_board_is_followed_and_positions_of_the_host_are_not() -> None:
    stream = coded()
    bench = Bench(replace(BOARD, position_sensor=lambda now_us: 50 * now_us))
    bench.start_all(stream)
    bench.send_payload(pack(Position(0, 10**12)))
    bench.run(300)
    hand = [(time_us, 50 * time_us) for time_us in range(0, 300_000, 1000)]
    shifted = [(time_us + HAND_DELAY_US, place) for time_us, place in hand]
    _, expected = render(stream.header, stream.decoded, stream.delay_samples, shifted, 900, PIEZO_STACK)
    # Only the low-passes are waited for: by 20 ms earlier than a host's hand.
    early = round(HAND_DELAY_US * RATE_HZ / 1e6)
    assert (
        np.corrcoef(bench.all_codes()[200 : 800 - early, 0], expected[200 + 2 * early : 800 + early, 0])[0, 1] > 0.999
    )


messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(Position, st.integers(0, 400_000) | st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1)),
    st.builds(Position, st.just(0), st.integers(-(10**8), 10**8)),
    st.sampled_from([Pause(), Resume(), Loop(1), Loop(2), Start()]),
    st.integers(0, len(coded().packets) - 1).map(lambda number: StreamData(7, 0, (coded().packets[number],))),
)


@given(st.sampled_from([PIEZO_STACK, LRA]), st.lists(st.one_of(messages, messages, st.integers(1, 60)), max_size=40))
@settings(max_examples=30, deadline=None)
def test_output_stays_within_its_limits_under_any_hand(actuator: Actuator, steps: list[Message | int]) -> None:
    bench = Bench(replace(BOARD, actuator=actuator))
    bench.start_all(coded())
    bench.run(40)
    for step in steps:
        if isinstance(step, int):
            bench.run(step, polling=False)
        elif isinstance(step, (Position, StreamData)):
            bench.send_payload(pack(step))
        else:
            bench.ask(step)
    bench.ask(Stop())
    codes = bench.all_codes()
    assert np.abs(np.diff(codes.astype(int), axis=0, prepend=0)).max(initial=0) <= actuator.code_step_limit
    assert not codes[-1:].any()
