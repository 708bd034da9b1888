"""The output of the C controller against rules of its own: ramps, limits, time, and what a loss sounds like."""

from dataclasses import replace

import numpy as np

from tests.simulated_device.bench import RATE_HZ, Bench, Stream, stream
from vibrocast import codec
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.messages import Configure, Gain, Hello, Start, State, Stop, Tap
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


def test_the_position_never_runs_ahead_of_the_clock() -> None:
    bench = Bench()
    bench.start_all(stream(), loops=1)
    started_us = bench.now_us
    for _ in range(150):
        bench.run(3)
        assert bench.status().position <= (bench.now_us - started_us) * RATE_HZ / 1e6 + 2 * 16


def test_packets_that_come_too_late_take_no_room() -> None:
    played = stream(2.0)
    bench = Bench()
    bench.ask(Hello())
    bench.ask(Configure(7, played.header.pack(), 280, packets=len(played.packets)))
    bench.send(played, range(4))
    bench.ask(Start())
    bench.run(900)
    before = bench.status()
    late = before.position // played.packet_samples - 2
    assert late > 8
    bench.send(played, range(4, late))
    after = bench.status()
    assert after.buffered_samples == before.buffered_samples
    assert after.credit_until == before.credit_until


def test_a_lost_packet_fades_and_does_not_break_off() -> None:
    played = stream(2.0)
    lost = next(number for number, packet in enumerate(played.packets) if number > 4 and packet[0] & 1) + 1
    bench = Bench()
    bench.configure(played)
    bench.send(played, range(lost))
    bench.send(played, range(lost + 1, len(played.packets)))
    bench.ask(Start())
    bench.run(2300)
    gap = bench.captured(Tap.DECODED)[lost * played.packet_samples :][: played.packet_samples, 0].astype(float)
    second, last = (
        gap[len(gap) // 4 : len(gap) // 2],
        gap[-len(gap) // 8 :],
    )  # the first quarter overlaps with the packet before
    clean = played.decoded[: lost * played.packet_samples].astype(float)
    assert np.sqrt(np.mean(second**2)) > 0.2 * np.sqrt(np.mean(clean**2))
    assert np.abs(last).max() < 0.5 * np.abs(second).max()
