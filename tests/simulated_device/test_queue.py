"""A stream that is queued behind the one under way: it follows without a gap, and only where the format is the same."""

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import noise
from tests.simulated_device.bench import Bench
from vibrocast import codec
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.messages import (
    Error,
    ErrorCode,
    Gain,
    Loop,
    Message,
    Queue,
    SinglePacket,
    Start,
    State,
    Status,
    Stop,
    StreamData,
    pack,
)
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import render


def stream(seconds: float, seed: int, packet_samples: int = 128, **setting: float | str) -> Stream:
    """Return noise that is coded at a full scale of 4."""
    framing = codec.Framing(packet_samples, 5)
    samples = np.clip(noise(seconds, rms=1.0, seed=seed), -3.9, 3.9)
    samples[0] = 4.0
    return codec.encode(samples, 2800, setting, unit="um", live=True, framing=framing)


FIRST, SECOND = stream(0.5, 1, step=0.3), stream(0.4, 2, 320, step=0.6, hop="64")


def queue(bench: Bench, played: Stream, number: int = 8, header: StreamHeader | None = None) -> Message:
    return bench.ask(Queue(number, (header or played.header).pack(), prebuffer_samples=0, packets=len(played.packets)))


def begun(bench: Bench, loops: int = 1) -> None:
    """Configure the first stream, send all of it, and start it."""
    answer = bench.configure(FIRST, loops=loops)  # type: ignore
    assert isinstance(answer, Status), answer
    for iteration in range(loops):
        bench.send_payload(pack(StreamData(7, iteration, FIRST.packets)))
    bench.ask(Start())


def send(bench: Bench, played: Stream, number: int = 8) -> None:
    """Send what there is credit for, and let time pass, until all packets are sent."""
    sent = 0
    while sent < len(played.packets):
        queued = bench.status().queued
        credit = bench.status().credit_until if queued is None else queued.credit_until
        while sent < min(len(played.packets), credit // played.packet_samples):
            bench.send_payload(pack(SinglePacket(number, played.packets[sent])))
            sent += 1
        bench.run(10)


def test_frames_out_of_turn_are_counted_ahead_of_their_stream_and_after_it_has_begun() -> None:
    bench = Bench()
    begun(bench)
    queue(bench, SECOND)
    for number in (1, 0, 1):
        bench.send_payload(pack(SinglePacket(8, SECOND.packets[number])))
    assert (bench.status().repeated_frames, bench.status().reordered_frames) == (1, 1)
    bench.run(700)
    bench.send_payload(pack(SinglePacket(8, SECOND.packets[1])))
    status = bench.status()
    assert (status.stream, status.repeated_frames, status.reordered_frames) == (8, 2, 1)


@pytest.mark.parametrize("loops", [1, 2])
def test_it_follows_without_a_gap_bit_for_bit(loops: int) -> None:
    bench = Bench()
    begun(bench, loops)
    answer = queue(bench, SECOND)
    assert isinstance(answer, Status) and answer.coding is not None and answer.queued is not None
    assert (answer.stream, answer.queued.stream) == (7, 8)
    assert (answer.coding.packet_samples, answer.coding.delay_samples) == (320, SECOND.delay_samples)
    send(bench, SECOND)
    bench.run(1500)
    status = bench.status()
    assert (status.state, status.stream, status.underruns, status.lost_packets) == (State.FINISHED, 8, 0, 0)
    assert status.position == len(SECOND.packets) * 320 and status.queued is None
    assert status.output_gaps == 0
    expected, _ = render(
        FIRST.header,
        FIRST.decode_integers(),
        FIRST.delay_samples,
        PIEZO_STACK,
        loops=loops,
        behind=[(SECOND.header, SECOND.decode_integers(), SECOND.delay_samples)],
    )
    np.testing.assert_array_equal(np.concatenate(bench.codes), expected)


def test_packets_of_the_next_stream_neither_count_as_buffered_nor_hide_an_underrun() -> None:
    bench = Bench()
    bench.configure(FIRST)  # type: ignore[arg-type]
    sent = FIRST.packets[:-1]
    bench.send_payload(pack(StreamData(7, 0, sent)))
    bench.ask(Start())
    bench.run(50)
    queue(bench, SECOND)
    bench.send_payload(pack(StreamData(8, 0, SECOND.packets[:2])))
    status = bench.status()
    assert status.queued is not None
    assert status.position + status.buffered_samples == len(sent) * FIRST.packet_samples
    bench.run(round(1000 * FIRST.seconds))
    status = bench.status()
    assert (status.stream, status.underruns) == (8, 1)
    assert status.position + status.buffered_samples == 2 * SECOND.packet_samples


def test_a_third_follows_once_the_second_plays() -> None:
    bench = Bench()
    begun(bench)
    queue(bench, SECOND)
    answer = queue(bench, FIRST, 9)
    assert isinstance(answer, Error) and answer.code == ErrorCode.WRONG_STATE
    send(bench, SECOND)
    while bench.status().stream == 7:
        bench.run(10)
    assert isinstance(queue(bench, FIRST, 9), Status)
    send(bench, FIRST, 9)
    bench.run(1500)
    status = bench.status()
    assert (status.state, status.stream, status.lost_packets) == (State.FINISHED, 9, 0)


@pytest.mark.parametrize(
    "other",
    [
        replace(SECOND.header, rate_hz=2000),
        replace(SECOND.header, unit="m/s^2"),
        replace(SECOND.header, gains=(2.0,)),
    ],
    ids=lambda header: f"{header.rate_hz} {header.unit} {header.gains}",
)
def test_another_format_is_rejected_and_changes_nothing(other: StreamHeader) -> None:
    bench = Bench()
    begun(bench)
    answer = queue(bench, SECOND, header=other)
    assert isinstance(answer, Error) and answer.code == ErrorCode.BEYOND_LIMITS
    bench.run(800)
    assert (bench.status().state, bench.status().lost_packets) == (State.FINISHED, 0)


def test_a_live_or_later_stream_is_rejected_and_the_next_one_dropped_by_stop() -> None:
    bench = Bench()
    begun(bench, loops=1)
    live = Queue(8, SECOND.header.pack(), prebuffer_samples=0, packets=0)
    later = Queue(8, SECOND.header.pack(), prebuffer_samples=0, packets=len(SECOND.packets), first_packet=1)
    for wrong in (live, later):
        answer = bench.ask(wrong)
        assert isinstance(answer, Error) and answer.code == ErrorCode.BAD_VALUE
    queue(bench, SECOND)
    answer = bench.ask(Loop(0))
    assert isinstance(answer, Error) and answer.code == ErrorCode.WRONG_STATE
    assert isinstance(bench.ask(Gain(0.5)), Status)
    bench.ask(Stop())
    assert bench.status().queued is None


def test_it_is_taken_and_played_or_rejected_up_to_the_last_sample() -> None:
    taken = []
    for wait_ms in range(480, 560, 4):
        bench = Bench()
        begun(bench)
        bench.run(wait_ms)
        answer = queue(bench, SECOND)
        bench.run(1000)
        taken.append(isinstance(answer, Status))
        assert (bench.status().state, bench.status().stream) == (State.FINISHED, 8 if taken[-1] else 7), wait_ms
    assert taken == sorted(taken, reverse=True) and 0 < sum(taken) < len(taken)


def test_a_late_second_is_concealed() -> None:
    bench = Bench()
    begun(bench)
    queue(bench, SECOND)
    bench.run(700)
    status = bench.status()
    assert (status.stream, status.underruns) == (8, 1) and status.lost_packets > 0
