"""Live streaming in simulated time: what is sent is what is played, clocks that drift, sources that pause, cables."""

from collections.abc import Iterator

import numpy as np
import pytest

from tests.conftest import linked, noise, session
from vibrocast import codec
from vibrocast.codec import CodecError, Signal
from vibrocast.codec.source import live_format
from vibrocast.device_protocol.coded_stream import StreamError, packet_sequence
from vibrocast.device_protocol.messages import Start, State, Tap
from vibrocast.device_protocol.transports import TransportError
from vibrocast.errors import InputError
from vibrocast.host import live
from vibrocast.host.live import LiveCoding, LiveStream
from vibrocast.host.stream_session import read_capture
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.memory_link import MemoryLink

RATE_HZ = 2800
FORMAT = live_format(RATE_HZ, "um", [10.0])


def blocks(stream: LiveStream, samples: Signal) -> Iterator[Signal]:
    return (block for _, block in live.paced(stream, samples))


@pytest.mark.parametrize("name", ["mdct", "dct", "slp"])
def test_what_is_played_is_what_was_sent(name: str) -> None:
    _, controller = linked()
    stream = LiveStream(controller, FORMAT, coding=LiveCoding(codec_name=name))
    packets: list[bytes] = []
    for block in blocks(stream, noise(0.7, rms=2.0)):
        packets += stream.code(block)
        stream.send_packets(packets[stream.packets_sent :])
    result = stream.finish()
    assert result.status.state == State.FINISHED
    assert (result.underruns, result.lost_packets, result.streams) == (0, 0, 1)
    first, decoded = read_capture(controller, Tap.DECODED, 1)
    assert first == 0
    decoder = codec.decoder(stream.header.codec_identifier, stream.header.configuration, 1)
    expected = np.concatenate([decoder.decode(packet) for packet in packets])
    np.testing.assert_array_equal(decoded[: len(expected)], expected)
    assert len(decoded) >= round(0.7 * RATE_HZ) + decoder.delay_samples


def test_packets_are_as_short_as_the_codec_has_them_and_refresh_four_times_a_second() -> None:
    _, controller = linked()
    stream = LiveStream(controller, FORMAT)
    assert stream.packet_samples == 16
    packets = stream.code(noise(1.0, rms=2.0))
    refreshes = [number for number, packet in enumerate(packets) if packet[0] & 1]
    assert refreshes[:3] == [0, 43, 86]


@pytest.mark.parametrize("delay_ms", [5, 20, 100])
def test_nothing_is_lost_at_the_start_of_a_stream_over_long_round_trips(delay_ms: int) -> None:
    _, controller = linked(faults=[Fault(delay_ms=delay_ms)])
    stream = LiveStream(controller, FORMAT)
    result = live.play(stream, blocks(stream, noise(1.0, rms=2.0)))
    assert (result.underruns, result.lost_packets, result.streams) == (0, 0, 1)


def test_the_playout_delay_counts_from_the_arrival_of_the_first_packet_over_a_slow_link() -> None:
    link, controller = linked(faults=[Fault(bits_per_second=80_000)])
    stream = LiveStream(controller, FORMAT, playout_delay_s=0.04)
    ahead: list[float] = []
    for _, block in live.paced(stream, noise(1.0, rms=2.0)):
        stream.send(block)
        link.sleep(0.005)
        status = stream.status
        if status.state == State.PLAYING and status.position:
            ahead.append(status.buffered_samples / RATE_HZ)
    assert np.mean(ahead) == pytest.approx(0.04, abs=0.006)
    assert stream.finish().underruns == 0


def test_a_lost_start_is_sent_again() -> None:
    link, controller = linked()
    stream = LiveStream(controller, FORMAT)
    send = link.write
    swallowed: list[bytes] = []

    def swallow_once(data: bytes) -> None:
        if data[1:2] == bytes((Start.TYPE,)) and not swallowed:
            swallowed.append(data)
        else:
            send(data)

    link.write = swallow_once  # type: ignore[method-assign]
    result = live.play(stream, blocks(stream, noise(1.0, rms=2.0)))
    assert swallowed
    assert result.status.state == State.FINISHED
    assert result.underruns == 0


@pytest.mark.slow
@pytest.mark.parametrize("drift_ppm", [-3000, 3000])
def test_a_clock_that_drifts_restarts_the_stream_and_the_delay_stays_bounded(drift_ppm: int) -> None:
    _, controller = linked(Settings(drift_ppm=drift_ppm))
    stream = LiveStream(controller, FORMAT)
    longest_s = 0.0
    for _, block in live.paced(stream, noise(20.0, rms=2.0)):
        stream.send(block)
        longest_s = max(longest_s, stream.status.buffered_samples / RATE_HZ)
    assert stream.finish().streams > 1
    assert longest_s < 0.05


def test_a_source_that_pauses_goes_on_with_little_delay() -> None:
    link, controller = linked()
    stream = LiveStream(controller, FORMAT)
    for pause_s in (0.0, 1.0, 3.0):  # the last one is longer than the watchdog waits
        link.sleep(pause_s)
        for _, block in live.paced(stream, noise(1.0, rms=2.0)):
            stream.send(block)
        assert stream.status.state == State.PLAYING
        assert 0 < stream.status.buffered_samples < 0.05 * RATE_HZ
    assert stream.finish().streams == 3


def played_with_pauses(
    pauses: list[tuple[float, float]], keeps: bool = False, faults: list[Fault] | None = None
) -> live.LiveResult:
    """Play 2 s of a source that pauses at times, for so many seconds, and then may give all that it has kept."""
    link, controller = linked(faults=faults or [])
    stream = LiveStream(controller, FORMAT)
    samples = noise(2.0, rms=2.0)
    given, began_s = 0, controller.clock()

    def taken() -> int:
        """Return how many samples the source has given by now."""
        now_s = controller.clock() - began_s
        for at_s, length_s in pauses:
            now_s = at_s if at_s < now_s < at_s + length_s else now_s - (now_s > at_s and not keeps) * length_s
        return min(len(samples), round(now_s * RATE_HZ))

    def read(timeout_s: float) -> Signal | None:
        nonlocal given
        until_s = controller.clock() + timeout_s
        while given < len(samples) and taken() == given and controller.clock() < until_s:
            link.sleep(0.001)
        block, given = samples[given : taken()], taken()
        return block if len(block) or given < len(samples) else None

    return live.play(stream, live.heard(stream, read))


@pytest.mark.parametrize(
    ("pauses", "streams"),
    [
        ([], 1),
        ([(0.002, 3.0)], 1),  # before the first packet, and longer than the watchdog waits
        ([(0.5, 0.015)], 1),  # silence alone
        ([(0.5, 0.6)], 2),
        ([(0.5, 5.0)], 2),
        ([(0.2, 0.03), (0.5, 1.0), (1.5, 3.0)], 3),
    ],
)
def test_a_source_that_pauses_loses_nothing(pauses: list[tuple[float, float]], streams: int) -> None:
    result = played_with_pauses(pauses)
    assert (result.lost_packets, result.dropped_packets, result.underruns) == (0, 0, 0)
    assert (result.pauses, result.streams) == (len(pauses), streams)
    assert result.status.state == State.FINISHED


def test_a_source_that_pauses_over_a_slow_link_loses_nothing() -> None:
    result = played_with_pauses([(0.5, 0.6), (1.0, 0.03)], faults=[Fault(bits_per_second=115_200, delay_ms=5)])
    assert (result.lost_packets, result.underruns, result.pauses) == (0, 0, 2)


@pytest.mark.parametrize("length_s", [0.3, 1.2])
def test_what_a_source_kept_in_a_pause_is_left_out_and_not_lost(length_s: float) -> None:
    result = played_with_pauses([(0.5, length_s)], keeps=True)
    assert (result.lost_packets, result.pauses) == (0, 1)
    assert result.left_out_packets > 0
    assert result.status.state == State.FINISHED


@pytest.mark.parametrize("late_at", [30, 83])  # packets of 84
def test_a_program_that_is_late_leaves_packets_out_and_goes_on_with_a_refresh(late_at: int) -> None:
    link, controller = linked()
    stream = LiveStream(controller, FORMAT)
    sent: list[tuple[int, bool]] = []
    stream.on_packets = lambda packets: sent.extend(packet_sequence(packet) for packet in packets)
    for number, block in enumerate(blocks(stream, noise(0.48, rms=2.0))):
        if number == late_at:
            link.sleep(0.1)
        stream.send(block)
    result = stream.finish()
    assert (result.streams, result.dropped_packets > 0) == (1, True)
    goes_on_at = late_at + result.dropped_packets
    assert sent[late_at:][:1] == ([(goes_on_at, True)] if goes_on_at < 84 else [])


def test_a_pulled_cable_is_opened_again() -> None:
    wire = FaultyWire(SimulatedController())
    controller = session(MemoryLink(wire))
    stream = LiveStream(controller, FORMAT)

    def pulled() -> Iterator[Signal]:
        for number, block in enumerate(blocks(stream, noise(2.0, rms=2.0))):
            if number == 100:
                wire.change(Fault(cut=True, for_s=0.5))
            yield block

    result = live.play(stream, pulled())
    # The source kept half a second of blocks, by which the second stream was late.
    assert result.streams == 3
    assert result.status.state == State.FINISHED


def test_a_cable_that_stays_out_ends_in_an_error() -> None:
    wire = FaultyWire(SimulatedController())
    controller = session(MemoryLink(wire))
    stream = LiveStream(controller, FORMAT)
    stream.send(noise(0.1, rms=2.0))
    wire.change(Fault(cut=True, for_s=60.0))
    with pytest.raises(TransportError):
        live.play(stream, [noise(0.1, rms=2.0)], reconnect_s=1.0)


def test_an_interrupted_stream_is_stopped() -> None:
    _, controller = linked()
    stream = LiveStream(controller, FORMAT)

    def interrupted() -> Iterator[Signal]:
        yield from blocks(stream, noise(0.2, rms=2.0))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        live.play(stream, interrupted())
    assert controller.request_status().state == State.STOPPED


def test_a_source_that_does_not_keep_its_rate_is_rejected() -> None:
    link, controller = linked()
    stream = LiveStream(controller, FORMAT)

    def flood() -> Iterator[Signal]:
        for start in range(0, 60 * RATE_HZ, 16):
            if start % RATE_HZ == 0:
                link.sleep(0.05)
            yield np.zeros((16, 1))

    with pytest.raises(InputError, match="the source is not live"):
        live.play(stream, flood())
    assert controller.request_status().state == State.STOPPED


def test_a_computer_that_is_too_busy_does_not_make_its_source_one_that_is_not_live() -> None:
    link, controller = linked()
    stream = LiveStream(controller, FORMAT)

    def starved() -> Iterator[Signal]:
        busy_at_s = 1.0
        for block in blocks(stream, noise(12.0, rms=2.0)):
            if controller.clock() > busy_at_s:
                link.sleep(2.0)  # the backlog then comes at once
                busy_at_s = controller.clock() + 0.3
            yield block

    result = live.play(stream, starved())
    assert result.streams > 4


def test_what_a_source_kept_before_it_was_heard_is_passed_over() -> None:
    _, controller = linked()
    stream = LiveStream(controller, FORMAT)
    for start in range(0, 5 * RATE_HZ, 16):
        stream.send(noise(5.0, rms=2.0)[start : start + 16])
    result = live.play(stream, blocks(stream, noise(2.0, rms=2.0)))
    assert result.streams == 2
    assert result.underruns == 0
    assert (result.lost_packets, result.left_out_packets > 800) == (0, True)  # of 875


def test_what_cannot_be_streamed_is_rejected() -> None:
    _, controller = linked(Settings(channels=1))
    with pytest.raises(StreamError, match="2 channels, the controller has 1"):
        LiveStream(controller, live_format(RATE_HZ, "um", [1.0, 1.0]))
    with pytest.raises(CodecError, match="needs a model"):
        LiveStream(controller, FORMAT, coding=LiveCoding(codec_name="eva"))
    with pytest.raises(CodecError, match="NaN"):
        LiveStream(controller, FORMAT).send(np.full((16, 1), np.nan))


def test_an_end_that_a_busy_computer_hears_of_too_late_has_been_played(monkeypatch: pytest.MonkeyPatch) -> None:
    link, controller = linked()
    stream = LiveStream(controller, FORMAT)
    for block in blocks(stream, noise(0.5, rms=2.0)):
        stream.send(block)
    monkeypatch.setattr(controller, "poll", lambda timeout_s: link.sleep(2 * live._END_S))
    assert stream.finish().status.state in (State.FINISHED, State.WATCHDOG)
