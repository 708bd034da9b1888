"""From decoded samples to DAC codes: exact in any pieces, true to the units, and always within the limits."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.output import float_rendering
from vibrocast.codec.interface import Decoded
from vibrocast.device_protocol.coded_stream import UNITS, StreamHeader
from vibrocast.output.actuator import (
    ACTUATORS,
    LRA,
    PIEZO_STACK,
    SKIN_OVERSAMPLING,
    Actuator,
    Codes,
    Samples,
)
from vibrocast.output.rendering import (
    FADE_SECONDS,
    HIGH_PASS_HZ,
    Dac,
    Drive,
    DriveSamples,
    LimitCounts,
    render,
)

FULL_SCALE_DRIVE = 2**25


def header(rate_hz: int, unit: str, gains: tuple[float, ...], samples: int | None = None) -> StreamHeader:
    return StreamHeader(1, rate_hz, samples, unit, gains, b"")


def dac_of(actuator: Actuator, gain: float) -> Dac:
    """A DAC of one channel whose drive is in parts of its full scale, without compensation."""
    return Dac(header(actuator.dac_rate_hz, "full scale", (1.0,)), actuator, gain, False)


def drive_of(parts: Samples) -> DriveSamples:
    """The drive for parts of full scale."""
    drive: DriveSamples = np.rint(parts * FULL_SCALE_DRIVE).astype(np.int32)
    return drive


def resampled(rate_hz: int, dac_rate_hz: int, samples: Samples) -> Samples:
    """Samples of at most 1 at the rate of a DAC, before its limits."""
    described = replace(PIEZO_STACK, dac_rate_hz=dac_rate_hz)
    drive = Drive(header(rate_hz, "full scale", (1.0,)), described, compensation=False)
    return drive.push(np.rint(32767 * samples).astype(np.int16)) / FULL_SCALE_DRIVE


def noise(count: int, channels: int, seed: int, full_scale: float = 0.2) -> Decoded:
    signal = np.random.default_rng(seed).standard_normal((count, channels)) * full_scale * 32768
    return np.clip(np.rint(signal), -32768, 32767).astype(np.int16)


def cut(samples: NDArray[Any], cuts: Sequence[int]) -> list[NDArray[Any]]:
    return np.split(samples, sorted(min(at, len(samples)) for at in cuts))


def sine(rate_hz: float, frequency_hz: float, amplitude: float, seconds: float) -> Samples:
    time_s = np.arange(round(rate_hz * seconds)) / rate_hz
    return (amplitude * np.sin(2 * np.pi * frequency_hz * time_s))[:, None]


def amplitude_at(samples: Samples, frequency_hz: float, rate_hz: float) -> float:
    """Amplitude of one frequency in the last half second, a whole number of its periods."""
    tail = samples[-round(rate_hz / 2) :, 0]
    phase = np.exp(-2j * np.pi * frequency_hz * np.arange(len(tail)) / rate_hz)
    return float(2 * abs(np.mean(tail * phase)))


@settings(max_examples=40, deadline=None)
@given(
    rate_hz=st.sampled_from([500, 2800, 3000, 8000, 11_025]),
    unit=st.sampled_from(UNITS),
    channels=st.integers(1, 3),
    actuator=st.sampled_from(sorted(ACTUATORS)),
    compensation=st.booleans(),
    gain=st.sampled_from([0.0, 0.3, 1.0, 40.0]),
    count=st.integers(0, 700),
    cuts=st.lists(st.integers(0, 700), max_size=6),
    drive_cuts=st.lists(st.integers(0, 1500), max_size=6),
    loops=st.integers(1, 3),
    seed=st.integers(0, 99),
)
def test_pieces_give_the_same_bits_as_the_whole(
    rate_hz: int,
    unit: str,
    channels: int,
    actuator: str,
    compensation: bool,
    gain: float,
    count: int,
    cuts: list[int],
    drive_cuts: list[int],
    loops: int,
    seed: int,
) -> None:
    head = header(rate_hz, unit, (16.0,) * channels, count)
    delay_samples = min(count, 32)
    decoded = noise(count + delay_samples, channels, seed)
    options = {"compensation": compensation, "gain": gain, "loops": loops}
    whole, counts = render(head, decoded, delay_samples, ACTUATORS[actuator], **options)  # type: ignore[arg-type]
    drive = Drive(head, ACTUATORS[actuator], compensation, delay_samples)
    dac = Dac(head, ACTUATORS[actuator], gain, compensation, drive.drive_samples(delay_samples))
    pieces = [drive.push(piece) for piece in cut(decoded, cuts)]
    for _ in range(loops - 1):
        drive.join()
        pieces += [drive.push(piece) for piece in cut(decoded[delay_samples:], cuts)]
    pushed = np.concatenate([*pieces, drive.finish()])
    codes = np.concatenate([*(dac.play(piece) for piece in cut(pushed, drive_cuts)), dac.ramp_down()])
    np.testing.assert_array_equal(codes, whole)
    assert dac.counts == counts


@pytest.mark.slow
@pytest.mark.parametrize("compensation", [False, True])
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("rate_hz", [100, 500, 2800, 3000, 8000, 11_025, 44_100, 48_000])
def test_integers_agree_with_floating_point(rate_hz: int, unit: str, compensation: bool) -> None:
    decoded = noise(max(200, rate_hz * 2 // 5), 1, rate_hz)
    head = header(rate_hz, unit, (12.0 if unit == "m/s^2" else 30.0 if unit == "um" else 1.0,), len(decoded) - 32)
    for actuator in ACTUATORS.values():
        codes, _ = render(head, decoded, 32, actuator, compensation=compensation, loops=2)
        exact = float_rendering.render(head, decoded, 32, actuator, compensation, loops=2)
        assert len(codes) == len(exact)
        error = np.abs(codes.astype(int) - exact)
        assert error.max(initial=0) <= 2
        assert error.mean() <= 0.25


@pytest.mark.parametrize("dac_rate_hz", [44_100, 48_000, 96_000])
@pytest.mark.parametrize("name", ACTUATORS)
def test_integers_agree_with_floating_point_at_the_rates_of_sound_cards(name: str, dac_rate_hz: int) -> None:
    decoded, actuator = noise(300, 1, dac_rate_hz), replace(ACTUATORS[name], dac_rate_hz=dac_rate_hz)
    head = header(2800, "um", (30.0,), len(decoded))
    codes, _ = render(head, decoded, 0, actuator)
    error = np.abs(codes.astype(int) - float_rendering.render(head, decoded, 0, actuator, True, 1))
    assert error.max(initial=0) <= 2
    assert error.mean() <= 0.25


def limited(actuator: Actuator, volts_part: float, power_part: float, slew_part: float) -> Actuator:
    """An actuator with a part of its limits."""
    return replace(
        actuator,
        volts_limit=actuator.volts / 2 * max(volts_part, 0.5),
        power_limit=actuator.power_limit * power_part,
        slew_volts_per_second=actuator.slew_volts_per_second * slew_part,
    )


# Bits of a float32: any, and 0, the smallest, about 1e-7, 1, about 65 536, the largest.
FLOATS = st.one_of(st.integers(0, 0x7F7FFFFF), st.sampled_from([0, 1, 0x33D6BF95, 0x3F800000, 0x477FE000, 0x7F7FFFFF]))


@settings(max_examples=80, deadline=None)
@given(
    rate_hz=st.one_of(st.integers(100, 48_000), st.sampled_from([2800, 3000])),
    unit=st.sampled_from(UNITS),
    header_gain=st.integers(1, 0x7F7F),
    gains=st.tuples(FLOATS, FLOATS),
    actuator=st.sampled_from([*ACTUATORS.values(), replace(PIEZO_STACK, dac_bits=12), replace(LRA, dac_rate_hz=500)])
    | st.builds(limited, st.sampled_from([*ACTUATORS.values()]), *[st.sampled_from([0.0005, 0.1, 0.5, 1.0])] * 3),
    compensation=st.booleans(),
    kind=st.sampled_from(["square", "noise", "constant", "weak"]),
    decoder_delay=st.integers(0, 200),
    cuts=st.lists(st.integers(0, 500), max_size=6),
    seed=st.integers(0, 99),
)
def test_limits_hold_for_any_numbers_however_they_are_cut(
    rate_hz: int,
    unit: str,
    header_gain: int,
    gains: tuple[int, int],
    actuator: Actuator,
    compensation: bool,
    kind: str,
    decoder_delay: int,
    cuts: list[int],
    seed: int,
) -> None:
    generator = np.random.default_rng(seed)
    signals: dict[str, Callable[[], NDArray[Any]]] = {
        "square": lambda: 32767 * generator.choice([-1, 1], (50, 2)).repeat(10, axis=0),
        "noise": lambda: generator.integers(-32768, 32768, (500, 2)),
        "constant": lambda: np.tile(generator.choice([-32768, 32767], (1, 2)), (500, 1)),
        "weak": lambda: generator.integers(-1, 2, (500, 2)),
    }
    decoded: Decoded = signals[kind]().astype(np.int16)
    head = header(rate_hz, unit, (float_of(header_gain << 16), 1.0))

    def play(pieces: list[Decoded]) -> Codes:
        drive = Drive(head, actuator, compensation, decoder_delay)
        dac = Dac(head, actuator, float_of(gains[0]), compensation, drive.drive_samples(decoder_delay))
        codes = [dac.play(drive.push(piece)) for piece in pieces]
        dac.set_gain(float_of(gains[1]))
        drive.join()
        codes += [dac.play(drive.push(piece)) for piece in pieces]
        return np.concatenate([*codes, dac.play(drive.finish()), dac.ramp_down()])

    codes = play([decoded])
    np.testing.assert_array_equal(play(cut(decoded, cuts)), codes)
    assert codes.max(initial=0) <= actuator.code_limit
    assert codes.min(initial=0) >= -actuator.code_limit - 1
    assert max_step(np.concatenate((codes[:1] * 0, codes))) <= actuator.code_step_limit
    assert not codes[-1:].any()
    second = np.zeros((actuator.dac_rate_hz, 2), np.int16)
    assert highest_second(np.concatenate((second, codes, second)), actuator) <= actuator.power_limit


def float_of(bits: int) -> float:
    value: float = struct.unpack("<f", struct.pack("<I", bits))[0]
    return value


def highest_second(codes: NDArray[Any], actuator: Actuator) -> float:
    """The highest mean of the squared drive over any second, in the first channel."""
    second = actuator.dac_rate_hz
    energy = np.cumsum(np.concatenate((np.zeros(second), (codes[:, 0] / actuator.full_scale) ** 2)))
    return float(np.max(energy[second:] - energy[:-second]) / second)


def max_step(codes: NDArray[Any]) -> int:
    return int(np.abs(np.diff(codes.astype(int), axis=0)).max(initial=0))


NAMES = ["sine", "slow sine", "constant", "ramp", "noise"]


def recorded(name: str) -> Decoded:
    """A second of a signal that does not close on itself, behind a decoder's delay of 32 samples."""
    time_s = np.arange(2800) / 2800
    signals = {
        "sine": np.sin(2 * np.pi * 100.25 * time_s),
        "slow sine": np.sin(2 * np.pi * 50.3 * time_s),
        "constant": np.full(2800, 0.7),
        "ramp": np.linspace(-0.9, 0.9, 2800),
        "noise": noise(2800, 1, 1)[:, 0] / 32768,
    }
    decoded: Decoded = np.rint(32767 * np.concatenate((np.zeros(32), signals[name]))[:, None]).astype(np.int16)
    return decoded


def test_full_scale_at_the_rate_of_the_dac_goes_through_unchanged() -> None:
    decoded = noise(1000, 2, 3)
    codes, counts = render(header(3000, "full scale", (1.0, 1.0), 1000), decoded, 0, PIEZO_STACK, compensation=False)
    fade_samples = round(FADE_SECONDS * 3000)
    np.testing.assert_array_equal(codes[fade_samples:1000], decoded[fade_samples:])
    assert counts == LimitCounts()
    assert not codes[-1].any()


# A jump of a slow acceleration is no jump of the displacement, but a swing of it that the recording asks for.
@pytest.mark.parametrize(
    ("name", "unit"), [(name, unit) for name in NAMES for unit in UNITS if (name, unit) != ("ramp", "m/s^2")]
)
@pytest.mark.parametrize("compensation", [False, True])
def test_seam_of_a_recording_that_does_not_close_is_no_click(name: str, unit: str, compensation: bool) -> None:
    decoded, gain = recorded(name), {"um": 30.0, "full scale": 0.75, "m/s^2": 12.0}[unit]
    codes, _ = render(header(2800, unit, (gain,), 2800), decoded, 32, PIEZO_STACK, compensation=compensation, loops=3)
    single, _ = render(header(2800, unit, (gain,), 2800), decoded, 32, PIEZO_STACK, compensation=compensation)
    assert len(codes) == len(single) + 6000
    seam = slice(len(single) - 60, len(single) + 60)
    jump = np.ptp(single[200:-60].astype(int))
    fade_step = jump * np.pi / 2 / round(FADE_SECONDS * 3000)
    assert max_step(codes[seam]) <= 1.25 * max(max_step(single[200:-60]), fade_step)
    assert np.abs(codes[seam].astype(int)).max() <= 1.1 * np.abs(single[200:-60].astype(int)).max()


@pytest.mark.parametrize("frequency_hz", [50, 200, 600, 900])
def test_resampler_keeps_its_band(frequency_hz: int) -> None:
    sampled = resampled(2800, 3000, sine(2800, frequency_hz, 1.0, 2.0))
    assert amplitude_at(sampled, frequency_hz, 3000) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("frequency_hz", [2000, 2600, 3900])
def test_resampler_keeps_what_the_dac_cannot_play_out_of_its_band(frequency_hz: int) -> None:
    sampled = resampled(8000, 3000, sine(8000, frequency_hz, 1.0, 2.0))
    assert np.abs(sampled[500:]).max() < 2e-3


def test_resampler_delays_by_what_it_states() -> None:
    delay_s = Drive(header(2800, "full scale", (1.0,)), PIEZO_STACK, compensation=False).delay_seconds
    impulse = np.zeros((100, 1))
    impulse[28] = 1.0
    assert int(np.argmax(resampled(2800, 3000, impulse))) == pytest.approx((28 + delay_s * 2800) * 3000 / 2800, abs=1)
    assert delay_s * 2800 == pytest.approx(8)


@pytest.mark.parametrize("frequency_hz", [60, 150, 300, 400])
def test_acceleration_becomes_displacement(frequency_hz: int) -> None:
    amplitude_um = 5.0
    acceleration = amplitude_um * 1e-6 * (2 * np.pi * frequency_hz) ** 2
    decoded = np.rint(sine(2800, frequency_hz, acceleration / 64.0 * 32768, 3.0)).astype(np.int16)
    drive = Drive(header(2800, "m/s^2", (64.0,)), PIEZO_STACK, compensation=False).push(decoded)
    full_scale_um = 1e6 * 64.0 / (2 * np.pi * HIGH_PASS_HZ) ** 2
    displacement_um = drive / FULL_SCALE_DRIVE * full_scale_um
    assert amplitude_at(displacement_um, frequency_hz, 3000) == pytest.approx(amplitude_um, rel=0.02)


def test_constant_acceleration_moves_nothing_in_the_end() -> None:
    drive = Drive(header(2800, "m/s^2", (64.0,)), PIEZO_STACK, compensation=False)
    settled = drive.push(np.full((28_000, 1), 30_000, np.int16))
    assert not settled[-100:].any()


def test_skin_follows_a_displacement_recording_with_compensation() -> None:
    wanted_um = sine(2800, 200, 20.0, 2.0)
    decoded = np.rint(wanted_um / 40.0 * 32768).astype(np.int16)
    codes, counts = render(header(2800, "um", (40.0,), len(decoded)), decoded, 0, PIEZO_STACK)
    assert counts == LimitCounts()
    skin_um = PIEZO_STACK.displacement_um(codes[:-100], SKIN_OVERSAMPLING)
    assert amplitude_at(skin_um, 200, 3000 * SKIN_OVERSAMPLING) == pytest.approx(20.0, rel=0.01)


def test_compensation_clips_and_says_so() -> None:
    # Full scale at 400 Hz would need 1.79 times the drive: FACTS of the piezo stack.
    decoded = np.rint(sine(3000, 400, 32000, 0.5)).astype(np.int16)
    _, compensated = render(header(3000, "um", (40.0,), 1500), decoded, 0, PIEZO_STACK)
    assert compensated.compensation_clipped > 500
    assert compensated.voltage_limited == 0
    _, bare = render(header(3000, "um", (40.0,), 1500), decoded, 0, PIEZO_STACK, compensation=False)
    assert bare == LimitCounts()


def test_dac_of_twelve_bits_uses_its_codes() -> None:
    codes: Codes = dac_of(replace(PIEZO_STACK, dac_bits=12), 1.0).play(drive_of(np.full((100, 1), 0.5)))
    assert codes[-1, 0] == 1024
