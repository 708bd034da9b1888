"""The streaming player: credit, captures, loops, lost connections, stops - against a controller in simulated time."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from msgspec import structs

from tests.conftest import linked
from tests.host.scripted_controller import PACKET_SAMPLES, RATE_HZ, ScriptedController
from tests.simulated_device.bench import stream
from vibrocast import codec
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.messages import (
    Configure,
    Message,
    Pause,
    Resume,
    State,
    Status,
    StatusRequest,
)
from vibrocast.host.controller import ConnectionLost, Controller, ControllerError
from vibrocast.host.player import PlaybackSettings, Progress, play
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_wire import Fault

HEADER = StreamHeader(codec_identifier=1, rate_hz=RATE_HZ, samples=None, unit="um", gains=(1.0,), configuration=b"")
REFRESH_PACKETS = 10


@dataclass(frozen=True)
class Coded:
    packets: list[bytes]
    header: StreamHeader = HEADER
    packet_samples: int = PACKET_SAMPLES


def make_packets(count: int, refresh_packets: int = REFRESH_PACKETS) -> list[bytes]:
    packets = []
    for number in range(count):
        value = number * 2 + (number % refresh_packets == 0)
        sequence = bytes([value]) if value < 128 else bytes([value & 127 | 128, value >> 7])
        packets.append(sequence + b"payload")
    return packets


PACKETS = make_packets(150)
SECONDS = len(PACKETS) * PACKET_SAMPLES / RATE_HZ


@pytest.mark.parametrize("buffer_s", [0.05, 0.1])
def test_buffers_no_more_than_required_without_underrun(buffer_s: float) -> None:
    scripted = ScriptedController()
    scripted.largest_read_s = 0.002
    result = play(scripted.connect(), Coded(PACKETS), PlaybackSettings(buffer_s=buffer_s))
    assert result.state == State.FINISHED
    assert result.buffered_s <= buffer_s + PACKET_SAMPLES / RATE_HZ
    assert result.underruns == 0


def test_controller_that_holds_one_packet_gets_the_next_while_it_plays() -> None:
    played = stream(0.5)
    _, controller = linked(Settings(buffer_samples=played.packet_samples))
    result = play(controller, played)
    assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)


@pytest.mark.parametrize("fault", [Fault(lost=0.2), Fault(flipped=0.2), Fault(doubled=0.2)], ids=str)
def test_captures_that_are_slow_to_come_do_not_hold_up_the_data(fault: Fault) -> None:
    played = stream(3.0)
    for seed in range(4):
        small = Settings(buffer_samples=2048, capture_samples=4096)
        _, controller = linked(small, [structs.replace(fault, direction="to_host")], seed)
        result = play(controller, played, PlaybackSettings(capture=True))
        assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)
        assert result.decoded is not None
        np.testing.assert_array_equal(result.decoded, played.decoded)


@pytest.mark.parametrize("live", [True, False])
@pytest.mark.parametrize(("samples", "loops"), [(10, 200), (90, 60), (225, 30), (840, 10)])
def test_loops_of_short_recordings_keep_up_though_positions_run_ahead_of_time(
    samples: int, loops: int, live: bool, sim: Controller
) -> None:
    coded = codec.encode(np.sin(np.arange(samples) + 1.0)[:, None], 2800, {"step": 0.01}, live=live)
    decoder = codec.decoder(1, coded.header.configuration, 1)
    header = StreamHeader(1, 2800, samples, "um", coded.header.gains, coded.header.configuration)
    seen: list[Progress] = []
    result = play(
        sim,
        Coded(list(coded.packets), header, decoder.packet_samples),
        PlaybackSettings(loops=loops, buffer_s=0.1, capture=True, progress=seen.append),
    )
    assert result.state == State.FINISHED
    assert result.underruns == result.lost_packets == 0
    assert result.buffered_s < 0.1 + 3 * samples / 2800
    assert seen[-1].position_s == seen[-1].duration_s == pytest.approx(loops * samples / 2800)
    decoded = coded.decode_integers()
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, np.tile(decoded, (loops, 1)))


def test_loop_too_short_for_the_controller_is_rejected_with_its_reason(sim: Controller) -> None:
    coded = codec.encode(np.ones((1, 1)), 2800, {"step": 0.01})
    header = StreamHeader(1, 2800, 1, "um", coded.header.gains, coded.header.configuration)
    packet_samples = codec.decoder(1, coded.header.configuration, 1).packet_samples
    with pytest.raises(ControllerError, match="rejects the request: an iteration"):
        play(sim, Coded(list(coded.packets), header, packet_samples), PlaybackSettings(loops=50))


def test_loop_that_the_player_knows_nothing_of_is_named() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()

    def play_on(message: Message) -> Message | None:
        return replace(scripted.status(), position=scripted.position + 2000) if scripted.position > 500 else None

    scripted.answer = play_on
    with pytest.raises(ControllerError, match="by a Loop sent to it"):
        play(controller, Coded(PACKETS))


def test_endless_loop_plays_until_the_callback_stops_it() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()

    def stop_late(progress: Progress) -> None:
        assert progress.duration_s is None
        if progress.position_s > 10:
            controller.stop()

    result = play(controller, Coded(make_packets(20)), PlaybackSettings(loops=0, progress=stop_late))
    assert result.state == State.STOPPED
    assert result.seconds > 10
    assert result.underruns == 0


def test_pause_in_the_callback_is_no_stall() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()

    def pause_for_ten_seconds(progress: Progress) -> None:
        if progress.status.state == State.PLAYING and 0.5 < progress.position_s < 0.6 and scripted.now_s < 5:
            controller.request(Pause(), Status)
        elif progress.status.state == State.PAUSED and scripted.now_s > 10:
            controller.request(Resume(), Status)

    result = play(controller, Coded(PACKETS), PlaybackSettings(progress=pause_for_ten_seconds))
    assert result.state == State.FINISHED
    assert result.seconds > 10
    assert scripted.received == set(range(len(PACKETS)))


def unplug_between(scripted: ScriptedController, start_s: float, end_s: float) -> None:
    def unplug() -> None:
        scripted.unplugged = start_s <= scripted.now_s < end_s

    scripted.at_read = unplug


def test_restarted_controller_goes_on_within_the_loops() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    restarted: list[bool] = []

    def restart_once() -> None:
        if scripted.position >= 450 and not restarted:
            restarted.append(True)
            scripted.restart()

    scripted.at_read = restart_once
    result = play(controller, Coded(make_packets(20)), PlaybackSettings(loops=4))
    _, second = (message for message in scripted.handled if isinstance(message, Configure))
    assert result.state == State.FINISHED
    assert (second.first_packet, second.loops) in [(0, 2), (10, 2), (0, 1)]


def test_a_long_cut_of_a_stream_with_one_refresh_is_reported() -> None:
    scripted = ScriptedController()
    unplug_between(scripted, 1.5, 4.0)
    with pytest.raises(ControllerError, match="no later packet can be decoded alone"):
        play(scripted.connect(), Coded(make_packets(500, refresh_packets=1000)))


def test_controller_whose_watchdog_bites_again_and_again_is_given_up() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()

    def bite(message: Message) -> Message | None:
        bites = isinstance(message, StatusRequest) and scripted.configure is not None
        return replace(scripted.status(), state=State.WATCHDOG, position=0) if bites else None

    scripted.answer = bite
    with pytest.raises(ConnectionLost, match="heard nothing"):
        play(controller, Coded(PACKETS))
    assert scripted.reopened <= 2


def test_fault_of_the_hardware_is_an_error() -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.answer = lambda _: replace(scripted.status(), state=State.FAULT) if scripted.position > 300 else None
    with pytest.raises(ControllerError, match="fault"):
        play(controller, Coded(PACKETS))


def test_data_that_comes_too_late_is_dropped_up_to_the_next_refresh() -> None:
    scripted = ScriptedController()

    def jump() -> None:
        if scripted.state == State.PLAYING and scripted.position < 300:
            scripted.position = 605

    scripted.at_read = jump
    result = play(scripted.connect(), Coded(PACKETS))
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
        play(ScriptedController().connect(), Coded(packets, packet_samples=packet_samples))
