"""The output of the C controller against rules of its own: ramps and limits."""

from dataclasses import replace

import numpy as np

from tests.simulated_device.bench import RATE_HZ, Bench, Stream
from vibrocast import codec
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.messages import Gain, State, Stop
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import FADE_SECONDS
from vibrocast.simulated_device.controller import Settings

DAC_HZ = PIEZO_STACK.dac_rate_hz
FADE_CODES = round(FADE_SECONDS * DAC_HZ)


def drive(signal: np.ndarray) -> Stream:
    """Code a drive, 1 = full scale, finely."""
    coded = codec.encode(signal[:, None], RATE_HZ, {"step": 0.01}, live=True)
    header = StreamHeader(1, RATE_HZ, len(signal), "full scale", coded.gains, coded.configuration)
    decoder = codec.decoder(1, coded.configuration, 1)
    return Stream(header, coded.packets, codec.decode_integers(coded), decoder.packet_samples, decoder.delay_samples)


def steady(seconds: float = 1.0) -> Stream:
    return drive(np.full(round(seconds * RATE_HZ), 0.5))


def square_wave(frequency_hz: float, seconds: float = 1.0) -> Stream:
    return drive(np.sign(np.sin(2 * np.pi * frequency_hz * np.arange(round(seconds * RATE_HZ)) / RATE_HZ)))


def test_a_start_fades_in_over_the_whole_fade() -> None:
    bench = Bench()
    bench.start_all(steady(), compensation=False)
    bench.run(500)
    codes = np.abs(bench.all_codes()[:, 0].astype(int))
    level = codes[-100:].min()
    rising = np.flatnonzero(codes > 0.1 * level)[0]
    risen = np.flatnonzero(codes > 0.9 * level)[0]
    assert risen - rising > FADE_CODES // 3
    assert np.abs(np.diff(codes)).max() < 2 * level / FADE_CODES


def test_the_gain_moves_over_20_ms() -> None:
    bench = Bench()
    bench.start_all(steady(), compensation=False)
    bench.run(300)
    before = len(bench.all_codes()) - 1
    bench.ask(Gain(0.25))
    bench.run(300)
    codes = np.abs(bench.all_codes()[before:, 0].astype(int))
    change = codes[0] - codes[-1]
    assert abs(codes[-1] / codes[0] - 0.25) < 0.02
    assert np.abs(np.diff(codes)).max() < change / 20
    assert np.abs(codes[round(0.021 * DAC_HZ) :] - codes[-1]).max() < change / 20


def test_no_step_exceeds_the_slew_limit() -> None:
    actuator = replace(PIEZO_STACK, slew_volts_per_second=10_000.0)
    bench = Bench(Settings(actuator=actuator))
    bench.start_all(square_wave(20), compensation=False)
    bench.run(900)
    steps = np.abs(np.diff(bench.all_codes()[:, 0].astype(int)))
    most_volts = actuator.slew_volts_per_second / DAC_HZ
    volts = steps * actuator.volts / 2**actuator.dac_bits
    assert volts.max() <= most_volts
    assert volts.max() > 0.99 * most_volts
    assert bench.status().slew_limited > 100


def test_a_start_waits_until_the_power_limit_has_recovered() -> None:
    bench = Bench()
    loud = square_wave(20)
    bench.start_all(loud, compensation=False)
    bench.run(800)
    assert bench.status().power_limited > 100
    bench.ask(Stop())
    bench.start_all(loud, compensation=False)
    bench.run(20)
    assert bench.status().state == State.ARMED
    bench.run(300)
    assert bench.status().state == State.PLAYING
