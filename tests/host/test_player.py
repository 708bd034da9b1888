"""The streaming player: credit, captures, loops, lost connections, stops - against a controller in simulated time."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.host.scripted_controller import PACKET_SAMPLES, RATE_HZ, ScriptedController
from tests.simulated_device.bench import stream
from vibrocast import codec
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.messages import (
    CaptureData,
    CaptureRead,
    Configure,
    Message,
    Pause,
    Resume,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
)
from vibrocast.device_protocol.transports import TransportError, UsbTransport
from vibrocast.host.controller import ConnectionLost, Controller, ControllerError
from vibrocast.host.player import Progress, play
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_link import MemoryLink
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.usb_backend import PRODUCT_ID, VENDOR_ID, UsbPort

HEADER = StreamHeader(codec_identifier=1, rate_hz=RATE_HZ, samples=None, unit="um", gains=(1.0,), configuration=b"")
REFRESH_PACKETS = 10


def make_packets(count: int, refresh_packets: int = REFRESH_PACKETS) -> list[bytes]:
    packets = []
    for number in range(count):
        value = number * 2 + (number % refresh_packets == 0)
        sequence = bytes([value]) if value < 128 else bytes([value & 127 | 128, value >> 7])
        packets.append(sequence + b"payload")
    return packets


PACKETS = make_packets(150)
SECONDS = len(PACKETS) * PACKET_SAMPLES / RATE_HZ


def connect(scripted: ScriptedController) -> Controller:
    return Controller(scripted, scripted.clock, scripted.sleep)


def test_plays_to_the_end_without_underrun() -> None:
    scripted = ScriptedController()
    seen: list[Progress] = []
    result = play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES, progress=seen.append)
    assert result.state == State.FINISHED
    assert result.underruns == result.lost_packets == result.reconnects == 0
    assert SECONDS <= result.seconds < SECONDS + 0.5
    assert scripted.received == set(range(len(PACKETS)))
    assert 0 < result.buffered_s <= 0.2
    assert result.wire_bytes_sent > sum(map(len, PACKETS))
    assert result.wire_bytes_received > 0
    positions = [progress.position_s for progress in seen]
    assert positions == sorted(positions)
    assert seen[-1].position_s == seen[-1].duration_s == SECONDS
    assert result.decoded is None


@pytest.mark.parametrize("buffer_s", [0.05, 0.1])
def test_buffers_no_more_than_required_without_underrun(buffer_s: float) -> None:
    scripted = ScriptedController()
    scripted.largest_read_s = 0.002
    result = play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES, buffer_s=buffer_s)
    assert result.state == State.FINISHED
    assert result.buffered_s <= buffer_s + PACKET_SAMPLES / RATE_HZ
    assert result.underruns == 0


def test_controller_that_holds_one_packet_gets_the_next_while_it_plays() -> None:
    played = stream(0.5)
    link = MemoryLink(SimulatedController(Settings(buffer_samples=played.packet_samples)))
    result = play(Controller(link, link.clock, link.sleep), played.header, played.packets, played.packet_samples)
    assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)


def test_captures_are_read_back_whole_though_the_controller_keeps_less() -> None:
    scripted = ScriptedController()
    result = play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES, capture=True)
    samples = np.arange(len(PACKETS) * PACKET_SAMPLES)[:, np.newaxis]
    assert len(samples) > scripted.description.limits.capture_samples
    assert result.decoded is not None
    assert result.dac_codes is not None
    np.testing.assert_array_equal(result.decoded, samples)
    np.testing.assert_array_equal(result.dac_codes, -samples)


@pytest.mark.parametrize("fault", ["lost", "flipped", "doubled"])
def test_captures_that_are_slow_to_come_do_not_hold_up_the_data(fault: str) -> None:
    played = stream(3.0)
    for seed in range(4):
        small = SimulatedController(Settings(buffer_samples=2048, capture_samples=4096))
        link = MemoryLink(FaultyWire(small, [Fault(direction="to_host", **{fault: 0.2})], seed))
        controller = Controller(link, link.clock, link.sleep)
        result = play(controller, played.header, played.packets, played.packet_samples, capture=True)
        assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)
        assert result.decoded is not None
        np.testing.assert_array_equal(result.decoded, played.decoded)


@pytest.mark.parametrize("count", [1, 7])
def test_short_streams_and_loops_play_every_iteration(count: int) -> None:
    scripted = ScriptedController()
    result = play(connect(scripted), HEADER, make_packets(count), PACKET_SAMPLES, loops=5)
    assert result.state == State.FINISHED
    assert result.underruns == 0
    assert scripted.received == set(range(5 * count))


@pytest.mark.parametrize("live", [True, False])
@pytest.mark.parametrize(("samples", "loops"), [(10, 200), (90, 60), (225, 30), (840, 10)])
def test_loops_of_short_recordings_keep_up_though_positions_run_ahead_of_time(
    samples: int, loops: int, live: bool
) -> None:
    coded = codec.encode(np.sin(np.arange(samples) + 1.0)[:, None], 2800, {"step": 0.01}, live=live)
    decoder = codec.decoder(1, coded.configuration, 1)
    header = StreamHeader(1, 2800, samples, "um", coded.gains, coded.configuration)
    link = MemoryLink(SimulatedController())
    controller = Controller(link, link.clock, link.sleep)
    seen: list[Progress] = []
    result = play(
        controller,
        header,
        coded.packets,
        decoder.packet_samples,
        loops=loops,
        buffer_s=0.1,
        capture=True,
        progress=seen.append,
    )
    assert result.state == State.FINISHED
    assert result.underruns == result.lost_packets == 0
    assert result.buffered_s < 0.1 + 3 * samples / 2800
    assert seen[-1].position_s == seen[-1].duration_s == pytest.approx(loops * samples / 2800)
    decoded = codec.decode_integers(coded)
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, np.tile(decoded, (loops, 1)))


def test_loop_too_short_for_the_controller_is_rejected_with_its_reason() -> None:
    coded = codec.encode(np.ones((1, 1)), 2800, {"step": 0.01})
    header = StreamHeader(1, 2800, 1, "um", coded.gains, coded.configuration)
    packet_samples = codec.decoder(1, coded.configuration, 1).packet_samples
    link = MemoryLink(SimulatedController())
    with pytest.raises(ControllerError, match="rejects the request: an iteration"):
        play(Controller(link, link.clock, link.sleep), header, coded.packets, packet_samples, loops=50)


def test_loop_that_the_player_knows_nothing_of_is_named() -> None:
    scripted = ScriptedController()
    controller = connect(scripted)

    def play_on(message: Message) -> Message | None:
        return replace(scripted.status(), position=scripted.position + 2000) if scripted.position > 500 else None

    scripted.answer = play_on
    with pytest.raises(ControllerError, match="by a Loop sent to it"):
        play(controller, HEADER, PACKETS, PACKET_SAMPLES)


def test_endless_loop_plays_until_the_callback_stops_it() -> None:
    scripted = ScriptedController()
    controller = connect(scripted)

    def stop_late(progress: Progress) -> None:
        assert progress.duration_s is None
        if progress.position_s > 10:
            controller.stop()

    result = play(controller, HEADER, make_packets(20), PACKET_SAMPLES, loops=0, progress=stop_late)
    assert result.state == State.STOPPED
    assert result.seconds > 10
    assert result.underruns == 0


def test_pause_in_the_callback_is_no_stall() -> None:
    scripted = ScriptedController()
    controller = connect(scripted)

    def pause_for_ten_seconds(progress: Progress) -> None:
        if progress.status.state == State.PLAYING and 0.5 < progress.position_s < 0.6 and scripted.now_s < 5:
            controller.request(Pause(), Status)
        elif progress.status.state == State.PAUSED and scripted.now_s > 10:
            controller.request(Resume(), Status)

    result = play(controller, HEADER, PACKETS, PACKET_SAMPLES, progress=pause_for_ten_seconds)
    assert result.state == State.FINISHED
    assert result.seconds > 10
    assert scripted.received == set(range(len(PACKETS)))


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_whatever_is_raised_the_controller_is_stopped_and_usable(error: type[BaseException]) -> None:
    scripted = ScriptedController()
    controller = connect(scripted)

    def interrupt(progress: Progress) -> None:
        if progress.position_s > 0.3:
            raise error

    with pytest.raises(error):
        play(controller, HEADER, PACKETS, PACKET_SAMPLES, progress=interrupt)
    assert scripted.handled[-1] == Stop()
    assert play(controller, HEADER, PACKETS, PACKET_SAMPLES).state == State.FINISHED


def unplug_between(scripted: ScriptedController, start_s: float, end_s: float) -> None:
    def unplug() -> None:
        scripted.unplugged = start_s <= scripted.now_s < end_s

    scripted.at_read = unplug


def test_after_a_short_cut_playing_resumes_where_the_controller_is() -> None:
    scripted = ScriptedController()
    unplug_between(scripted, 0.43, 0.53)
    result = play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES)
    assert result.state == State.FINISHED
    assert result.reconnects == 1
    assert sum(isinstance(message, Configure) for message in scripted.handled) == 1
    assert scripted.received == set(range(len(PACKETS)))


def test_after_a_long_cut_playing_resumes_at_the_next_refresh() -> None:
    scripted = ScriptedController()
    unplug_between(scripted, 0.5, 3.0)
    result = play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES, capture=True)
    first, second = (message for message in scripted.handled if isinstance(message, Configure))
    assert (first.first_packet, second.first_packet % REFRESH_PACKETS) == (0, 0)
    assert 50 <= second.first_packet <= 100
    assert second.stream != first.stream
    assert result.state == State.FINISHED
    assert result.captured_from == second.first_packet
    assert result.decoded is not None
    assert len(result.decoded) == (len(PACKETS) - second.first_packet) * PACKET_SAMPLES


def test_restarted_controller_goes_on_within_the_loops() -> None:
    scripted = ScriptedController()
    controller = connect(scripted)
    restarted: list[bool] = []

    def restart_once() -> None:
        if scripted.position >= 450 and not restarted:
            restarted.append(True)
            scripted.restart()

    scripted.at_read = restart_once
    result = play(controller, HEADER, make_packets(20), PACKET_SAMPLES, loops=4)
    _, second = (message for message in scripted.handled if isinstance(message, Configure))
    assert result.state == State.FINISHED
    assert (second.first_packet, second.loops) in [(0, 2), (10, 2), (0, 1)]


def test_a_long_cut_of_a_stream_with_one_refresh_is_reported() -> None:
    scripted = ScriptedController()
    unplug_between(scripted, 0.5, 3.0)
    with pytest.raises(ControllerError, match="no later packet can be decoded alone"):
        play(connect(scripted), HEADER, make_packets(150, refresh_packets=1000), PACKET_SAMPLES)


def test_cable_that_stays_out_is_an_error() -> None:
    scripted = ScriptedController()
    unplug_between(scripted, 0.5, 1e9)
    with pytest.raises(TransportError, match="unplugged"):
        play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES, reconnect_s=5)
    assert scripted.now_s < 10


def test_stalled_usb_endpoints_do_not_disturb_the_playback() -> None:
    coded = codec.encode(np.sin(np.arange(1400) / 3.0)[:, None], 2800, {"step": 0.01}, live=True)
    header = StreamHeader(1, 2800, 1400, "um", coded.gains, coded.configuration)
    stalls: list[float] = []
    with UsbPort(SimulatedController()) as port, Controller(UsbTransport(VENDOR_ID, PRODUCT_ID, port)) as controller:

        def stall_now_and_then(progress: Progress) -> None:
            if progress.position_s >= 0.1 * (1 + len(stalls)):
                stalls.append(progress.position_s)
                port.stall()

        packet_samples = codec.decoder(1, coded.configuration, 1).packet_samples
        result = play(
            controller, header, coded.packets, packet_samples, buffer_s=0.2, capture=True, progress=stall_now_and_then
        )
    assert len(stalls) >= 3
    assert result.state == State.FINISHED
    assert result.underruns == result.lost_packets == result.reconnects == 0
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, codec.decode_integers(coded))


def test_controller_that_takes_no_data_is_given_up() -> None:
    scripted = ScriptedController()
    scripted.swallow = lambda message: isinstance(message, StreamData)
    with pytest.raises(ControllerError, match=r"has played only 0.0 s of the stream"):
        play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES)
    assert scripted.handled[-1] == Stop()


def test_controller_whose_watchdog_bites_again_and_again_is_given_up() -> None:
    scripted = ScriptedController()
    controller = connect(scripted)

    def bite(message: Message) -> Message | None:
        bites = isinstance(message, StatusRequest) and scripted.configure is not None
        return replace(scripted.status(), state=State.WATCHDOG, position=0) if bites else None

    scripted.answer = bite
    with pytest.raises(ConnectionLost, match="heard nothing"):
        play(controller, HEADER, PACKETS, PACKET_SAMPLES)
    assert scripted.reopened <= 2


def test_fault_of_the_hardware_is_an_error() -> None:
    scripted = ScriptedController()
    controller = connect(scripted)

    def fail(message: Message) -> Message | None:
        return status(scripted, State.FAULT) if scripted.position > 300 else None

    scripted.answer = fail
    with pytest.raises(ControllerError, match="fault"):
        play(controller, HEADER, PACKETS, PACKET_SAMPLES)


def status(scripted: ScriptedController, state: State) -> Status:
    return replace(scripted.status(), state=state)


def test_data_that_comes_too_late_is_dropped_up_to_the_next_refresh() -> None:
    scripted = ScriptedController()

    def jump() -> None:
        if scripted.state == State.PLAYING and scripted.position < 300:
            scripted.position = 605

    scripted.at_read = jump
    result = play(connect(scripted), HEADER, PACKETS, PACKET_SAMPLES)
    assert result.state == State.FINISHED
    late = [number for number in range(61, 70) if number in scripted.received]
    assert not late
    assert set(range(70, 150)) <= scripted.received


@pytest.mark.parametrize(
    ("packets", "packet_samples", "reason"),
    [
        ([], PACKET_SAMPLES, "no packets or no samples"),
        (PACKETS[1:], PACKET_SAMPLES, "packet 0 has the number 1"),
        ([b"\x00payload"], PACKET_SAMPLES, "does not begin with a random-access packet"),
        ([b"\x01" + bytes(64)], PACKET_SAMPLES, "lower rate"),
        (PACKETS, 201, "shorter packets"),
        ([b""], PACKET_SAMPLES, "truncated"),
    ],
)
def test_streams_that_cannot_be_played_are_rejected(packets: list[bytes], packet_samples: int, reason: str) -> None:
    with pytest.raises((StreamError, ControllerError), match=reason):
        play(connect(ScriptedController()), HEADER, packets, packet_samples)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"gains": (1.0, 1.0)}, "2 channels, the controller has 1"),
        ({"rate_hz": 99}, "99 Hz, the controller takes 100 to 48000 Hz"),
        ({"rate_hz": 48_001}, "48001 Hz"),
    ],
)
def test_streams_beyond_the_controllers_limits_are_rejected(change: dict[str, Any], reason: str) -> None:
    scripted = ScriptedController()
    with pytest.raises(StreamError, match=reason):
        play(connect(scripted), replace(HEADER, **change), PACKETS, PACKET_SAMPLES)
    assert not any(isinstance(message, Configure) for message in scripted.handled)


@settings(max_examples=60)
@given(st.data())
def test_controller_that_reports_nonsense_never_holds_the_player_for_ever(data: st.DataObject) -> None:
    scripted = ScriptedController()
    controller = connect(scripted)
    positions = st.one_of(st.integers(0, 1500), st.integers(0, (1 << 64) - 1))
    states = st.sampled_from([state for state in State if state != State.PAUSED])

    def lie(message: Message) -> Message | None:
        if isinstance(message, (Configure, Start, StatusRequest)) and data.draw(st.booleans()):
            state, position, credit = data.draw(states), data.draw(positions), data.draw(positions)
            return replace(scripted.status(), state=state, position=position, credit_until=credit)
        if isinstance(message, CaptureRead) and data.draw(st.booleans()):
            offset = data.draw(st.sampled_from([message.offset, 0, 1 << 60]))
            return CaptureData(message.tap, data.draw(st.integers(1, 2)), offset, 1 << 62, bytes(400))
        return None

    scripted.answer = lie
    scripted.check_credit = False
    try:
        result = play(controller, HEADER, PACKETS[:40], PACKET_SAMPLES, capture=True, reconnect_s=1)
        assert result.state in (State.FINISHED, State.STOPPED)
    except (ControllerError, TransportError) as error:
        assert str(error)
    assert scripted.now_s < 300
