"""The controller, message by message in simulated time: session, playing, memory limits, hostile bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.simulated_device.bench import RATE_HZ, SMALL, Bench, Stream, stream
from vibrocast.codec import CODECS, Framing, SignalFormat, dct, mdct
from vibrocast.device_protocol.coded_stream import IMAGE_HASH_BYTES, UNITS, StreamHeader
from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.messages import (
    ALL,
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    REQUESTS,
    CaptureData,
    CaptureRead,
    Configure,
    EndStream,
    Error,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashData,
    FlashStatus,
    FlashVerify,
    Gain,
    Hello,
    HelloResponse,
    Loop,
    Message,
    Pause,
    Resume,
    SlotState,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
    pack,
)
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.output.actuator import LRA, PIEZO_STACK
from vibrocast.output.rendering import FADE_SECONDS, render
from vibrocast.simulated_device.controller import FLASH_BYTES, Controller, Settings
from vibrocast.simulated_device.flash import FlashMemory

FADE_CODES = round(FADE_SECONDS * PIEZO_STACK.dac_rate_hz)


def configuration(blocks: int, hop: int, channels: int = 1) -> bytes:
    """A stream's codec configuration with packets of `blocks` blocks of `hop` samples."""
    return mdct.configuration(hop, blocks, [600] * channels)


def rendered(played: Stream, gain: float = 1.0, compensation: bool = True, loops: int = 1) -> np.ndarray:
    codes, _ = render(
        played.header,
        played.decoded,
        played.delay_samples,
        PIEZO_STACK,
        gain=gain,
        compensation=compensation,
        loops=loops,
    )
    return codes


def error_code(answer: Message) -> int:
    assert isinstance(answer, Error)
    assert answer.text
    return answer.code


def state_of(answer: Message) -> State:
    assert isinstance(answer, Status)
    return answer.state


# ---- session ----


def test_hello_describes_the_controller() -> None:
    hello = Bench(Settings(actuator=LRA, hardware="bench")).ask(Hello())
    assert isinstance(hello, HelloResponse)
    assert hello.hardware == "bench"
    assert hello.actuator.name == "lra"
    assert hello.codecs == tuple((codec.identifier, codec.name) for codec in CODECS.values())
    assert [image.state for image in hello.images] == [SlotState.EMPTY, SlotState.EMPTY]


def test_only_stop_is_carried_out_before_hello() -> None:
    bench = Bench()
    assert error_code(bench.ask(StatusRequest())) == ErrorCode.HELLO_FIRST
    assert state_of(bench.ask(Stop())) == State.STOPPED


def test_other_major_version_is_rejected_by_name_and_other_minor_is_not() -> None:
    bench = Bench()
    answer = bench.ask(Hello(major=PROTOCOL_MAJOR + 1, minor=3))
    assert error_code(answer) == ErrorCode.UNSUPPORTED_VERSION
    assert isinstance(answer, Error)
    assert f"{PROTOCOL_MAJOR}.{PROTOCOL_MINOR}" in answer.text
    assert f"{PROTOCOL_MAJOR + 1}.3" in answer.text
    assert error_code(bench.ask(StatusRequest())) == ErrorCode.HELLO_FIRST
    assert isinstance(bench.ask(Hello(minor=9)), HelloResponse)


def test_unknown_and_malformed_messages_are_answered_with_an_error() -> None:
    bench = Bench()
    bench.ask(Hello())
    for payload, code in ((b"\x3f\x02\x00", ErrorCode.UNKNOWN_MESSAGE), (b"\x04\x03\x00\x01", ErrorCode.MALFORMED)):
        (answer,) = bench.send_payload(payload)
        assert error_code(answer[1]) == code
    assert bench.send_payload(b"\x02\x00\x00") == []
    assert error_code(bench.notified[-1]) == ErrorCode.MALFORMED
    assert bench.send_payload(b"\x81\x05\x00") == []


def test_repeated_request_gets_the_same_answer_and_is_carried_out_once() -> None:
    bench = Bench()
    bench.start_all(stream())
    bench.run(100)
    paused = bench.ask(Pause())
    bench.run(50, polling=False)
    assert bench.ask_as(bench.sequence, Pause()) == paused
    resumed = bench.ask(Resume())
    assert state_of(resumed) == State.PLAYING
    late = bench.send_payload(pack(Pause(), bench.sequence - 1))
    assert late == []
    assert bench.status().state == State.PLAYING


def test_hello_opens_a_new_session_and_leaves_the_stream_alone() -> None:
    bench = Bench()
    bench.start_all(stream())
    bench.run(100)
    assert isinstance(bench.ask_as(40_000, Hello()), HelloResponse)
    assert state_of(bench.ask_as(40_001, StatusRequest())) == State.PLAYING
    assert bench.send_payload(pack(Hello(), 40_000)) == []


@pytest.mark.parametrize(
    "message", [Start(), Pause(), Resume(), Loop(2), Gain(0.5), EndStream(7, 1), CaptureRead(Tap.DAC, 0, 1)]
)
def test_without_a_stream_what_needs_one_is_rejected(message: Message) -> None:
    bench = Bench()
    bench.ask(Hello())
    assert error_code(bench.ask(message)) == ErrorCode.WRONG_STATE


def test_configure_rejects_what_cannot_be_played() -> None:
    bench = Bench()
    good = stream()
    assert state_of(bench.configure(good)) == State.BUFFERING
    header = good.header
    coding = header.configuration
    nine_channels = StreamHeader(1, RATE_HZ, 10, "um", (1.0,) * 9, coding)
    short_packets = replace(header, samples=None, configuration=configuration(1, 16))
    long_packets = replace(header, samples=None, configuration=configuration(1000, 64))
    rejected = [
        (Configure(1, b"VCT", 0), ErrorCode.BAD_VALUE),
        (Configure(1, header.pack() + b"x", 0), ErrorCode.BAD_VALUE),
        (Configure(1, header.pack(), 0, packets=0, loops=0), ErrorCode.BAD_VALUE),
        (Configure(1, header.pack(), 0, packets=5, first_packet=5), ErrorCode.BAD_VALUE),
        (Configure(1, header.pack(), 0, packets=len(good.packets) + 2), ErrorCode.BAD_VALUE),
        (Configure(1, header.pack(), 1 << 20, packets=5), ErrorCode.BEYOND_LIMITS),
        # 1024 packets is what the buffer holds, of 16 samples each; in longer ones, what fits into its samples.
        (Configure(1, short_packets.pack(), 16 * 1024 + 1), ErrorCode.BEYOND_LIMITS),
        (Configure(1, long_packets.pack(), 0), ErrorCode.BEYOND_LIMITS),
        (Configure(1, nine_channels.pack(), 0), ErrorCode.BEYOND_LIMITS),
        (Configure(1, replace(header, rate_hz=99).pack(), 0), ErrorCode.BEYOND_LIMITS),
        (Configure(1, replace(header, codec_identifier=15).pack(), 0), ErrorCode.UNKNOWN_CODEC),
        (Configure(1, replace(header, configuration=b"\xff").pack(), 0), ErrorCode.UNKNOWN_CODEC),
        (Configure(1, replace(header, image_hash=bytes(range(4))).pack(), 0), ErrorCode.UNKNOWN_IMAGE),
    ]
    for configure, code in rejected:
        answer = bench.ask(configure)
        assert error_code(answer) == code, configure
        if code == ErrorCode.UNKNOWN_IMAGE:
            assert isinstance(answer, Error)
            assert "00010203" in answer.text
    whole = dct.DctEncoder(
        dct.CODEC.complete({"block": "whole"}), SignalFormat(RATE_HZ, "um", (1.0,), (0.5,), 560), Framing(560, 0)
    ).configuration
    answer = bench.ask(Configure(1, StreamHeader(dct.IDENTIFIER, RATE_HZ, 560, "um", (1.0,), whole).pack(), 0))
    assert isinstance(answer, Error)
    assert (answer.code, "only hosts decode: encode in blocks" in answer.text) == (ErrorCode.UNKNOWN_CODEC, True)
    # A Configure that is rejected changes nothing.
    assert bench.status().stream == 7
    assert bench.status().state == State.BUFFERING


def test_number_of_the_last_request_opens_a_session_if_a_new_host_draws_it() -> None:
    bench = Bench()
    bench.ask(Hello())
    bench.ask(StatusRequest())
    assert isinstance(bench.ask_as(bench.sequence, Hello()), HelloResponse)
    assert isinstance(bench.ask_as(bench.sequence, Hello()), HelloResponse)
    bench.status()
    assert bench.send_payload(pack(Hello(), bench.sequence - 1)) == []


# ---- playing ----


@pytest.mark.parametrize(("channels", "unit"), [(1, "um"), (2, "m/s^2"), (3, "full scale"), (16, "um")])
def test_decoded_and_dac_are_bit_for_bit_those_computed_offline(channels: int, unit: str) -> None:
    played = stream(1.0, channels, unit)
    bench = Bench(Settings(channels=channels))
    bench.start_all(played, gain=0.5)
    bench.run(1300)
    status = bench.status()
    assert status.state == State.FINISHED
    assert (status.underruns, status.lost_packets) == (0, 0)
    assert status.position == len(played.decoded)
    np.testing.assert_array_equal(bench.captured(Tap.DECODED), played.decoded)
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played, gain=0.5))
    np.testing.assert_array_equal(bench.all_codes(), rendered(played, gain=0.5))


def test_steps_of_time_do_not_matter() -> None:
    played = stream()
    bench = Bench()
    bench.start_all(played)
    rng = np.random.default_rng(3)
    while bench.now_us < 1_300_000:
        bench.now_us += int(rng.integers(1, 60_000))
        bench.status()
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played))


def test_start_waits_for_its_time_and_for_the_prebuffer() -> None:
    played = stream()
    bench = Bench()
    bench.configure(played, prebuffer_samples=5 * played.packet_samples)
    assert state_of(bench.ask(Start(device_time_us=50_000))) == State.ARMED
    bench.send(played, range(4))
    bench.run(60)
    assert bench.status().state == State.ARMED
    bench.send(played, range(4, len(played.packets)))
    bench.run(1)
    assert bench.status().state == State.PLAYING
    bench.run(1300)
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played))


def test_controllers_started_for_one_time_play_together() -> None:
    played = stream()
    benches = [Bench(), Bench()]
    for delay_ms, bench in enumerate(benches):
        bench.configure(played)
        bench.send(played, range(len(played.packets)))
        bench.run(17 * delay_ms)
        bench.ask(Start(device_time_us=200_000))
        bench.run(700 - 17 * delay_ms)
    assert benches[0].now_us == benches[1].now_us
    assert benches[0].status().position == benches[1].status().position > 0
    np.testing.assert_array_equal(benches[0].all_codes(), benches[1].all_codes())


def test_playing_begins_without_what_was_lost_of_the_prebuffer() -> None:
    played = stream()
    bench = Bench()
    bench.configure(played, prebuffer_samples=len(played.decoded))
    bench.send(played, range(len(played.packets) - 1))
    bench.ask(Start())
    bench.run(900)
    assert bench.status().state == State.ARMED
    bench.run(1500)
    assert bench.status().state == State.FINISHED
    assert bench.status().lost_packets == 1


def test_pause_holds_the_position_and_resume_goes_on_with_the_next_sample() -> None:
    played = stream()
    bench = Bench()
    bench.start_all(played)
    bench.run(300)
    bench.ask(Pause())
    bench.run(20)
    position = bench.status().position
    played_codes = len(bench.all_codes())
    bench.run(500)
    assert bench.status().position == position
    assert len(bench.all_codes()) == played_codes
    assert not bench.all_codes()[-1].any()
    bench.ask(Resume())
    bench.run(1300)
    assert bench.status().state == State.FINISHED
    np.testing.assert_array_equal(bench.captured(Tap.DECODED), played.decoded)
    whole, paused = rendered(played), bench.captured(Tap.DAC)
    assert len(paused) == len(whole) + FADE_CODES
    resumed_at = 900 + FADE_CODES
    np.testing.assert_array_equal(paused[:900], whole[:900])
    np.testing.assert_array_equal(paused[resumed_at + FADE_CODES :], whole[900 + FADE_CODES :])


@pytest.mark.parametrize("sample_at_stop", [0, 1, 150, 333])
def test_stop_ramps_down_at_once_and_a_new_stream_can_follow(sample_at_stop: int) -> None:
    played = stream()
    bench = Bench()
    bench.start_all(played)
    bench.run(sample_at_stop)
    assert state_of(bench.ask(Stop())) == State.STOPPED
    stopped = bench.all_codes()
    assert len(stopped) <= 3 * sample_at_stop + FADE_CODES
    assert not len(stopped) or not stopped[-1].any()
    bench.run(500)
    assert len(bench.all_codes()) == len(stopped)
    bench.start_all(played)
    bench.run(1300)
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played))


def test_loops_repeat_the_stream_and_can_be_changed() -> None:
    played = stream(0.5)
    bench = Bench()
    bench.configure(played, loops=0)
    for iteration in range(3):
        bench.send(played, range(len(played.packets)), iteration)
    bench.ask(Start())
    bench.run(700)
    assert state_of(bench.ask(Loop(2))) == State.PLAYING
    bench.run(700)
    assert bench.status().state == State.FINISHED
    np.testing.assert_array_equal(bench.captured(Tap.DECODED), np.tile(played.decoded, (2, 1)))
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played, loops=2))


@pytest.mark.parametrize(
    ("samples", "blocks", "hop", "packets"),
    [(0, 4, 32, 1), (None, 1, 32, 1), (1, 4, 32, 1), (1, 512, 64, 1), (2, 1, 16, 2)],
)
@pytest.mark.parametrize("loops", [0, 2, 65_535])
def test_iteration_too_short_to_be_repeated_is_rejected(
    samples: int | None, blocks: int, hop: int, packets: int, loops: int
) -> None:
    bench = Bench()
    bench.ask(Hello())
    header = StreamHeader(1, RATE_HZ, samples, "um", (1.0,), configuration(blocks, hop))
    assert error_code(bench.ask(Configure(7, header.pack(), 0, packets=packets, loops=loops))) == ErrorCode.BAD_VALUE
    assert state_of(bench.ask(Configure(7, header.pack(), 0, packets=packets))) == State.BUFFERING
    assert error_code(bench.ask(Loop(loops))) == ErrorCode.BAD_VALUE
    bench.ask(Start())
    assert error_code(bench.ask(Loop(loops))) == ErrorCode.BAD_VALUE
    bench.run(2000)
    assert bench.status().state == State.FINISHED


def test_ten_samples_loop() -> None:
    played = stream(10 / RATE_HZ)
    bench = Bench()
    bench.configure(played, loops=200, prebuffer_samples=0)
    for iteration in range(200):
        bench.send(played, range(len(played.packets)), iteration)
    bench.ask(Start())
    bench.run(900)
    status = bench.status()
    assert (status.state, status.underruns, status.lost_packets) == (State.FINISHED, 0, 0)
    np.testing.assert_array_equal(bench.captured(Tap.DECODED), np.tile(played.decoded, (200, 1)))
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played, loops=200))


def test_every_iteration_begins_afresh_whatever_was_lost_before() -> None:
    played = stream(0.5)
    bench = Bench()
    bench.configure(played, loops=2)
    bench.send(played, range(len(played.packets) - 2))
    bench.send(played, range(len(played.packets)), iteration=1)
    bench.ask(Start())
    bench.run(1400)
    assert bench.status().lost_packets == 2
    np.testing.assert_array_equal(bench.captured(Tap.DECODED)[len(played.decoded) :], played.decoded)


def test_loop_count_already_passed_ends_after_this_iteration() -> None:
    played = stream(0.5)
    bench = Bench()
    bench.configure(played, loops=3)
    for iteration in range(3):
        bench.send(played, range(len(played.packets)), iteration)
    bench.ask(Start())
    bench.run(800)
    bench.ask(Loop(1))
    bench.run(1000)
    assert bench.status().state == State.FINISHED
    assert len(bench.captured(Tap.DECODED)) == 2 * len(played.decoded)


def test_what_is_left_in_the_buffer_goes_with_the_end() -> None:
    played = stream(0.5)
    bench = Bench()
    bench.configure(played, loops=3)
    for iteration in range(3):
        bench.send(played, range(len(played.packets)), iteration)
    bench.ask(Start())
    bench.run(100)
    bench.ask(Loop(1))
    bench.run(600)
    assert (bench.status().state, bench.status().buffered_samples) == (State.FINISHED, 0)


def test_stop_and_pause_in_the_last_ramp_keep_their_state() -> None:
    played = stream(0.3)
    whole = rendered(played)
    in_ramp_ms = (len(whole) - FADE_CODES // 2) // 3

    stopped, paused = Bench(), Bench()
    for bench, message, state in ((stopped, Stop(), State.STOPPED), (paused, Pause(), State.PAUSED)):
        bench.start_all(played)
        bench.run(in_ramp_ms)
        assert bench.status().state == State.PLAYING
        assert state_of(bench.ask(message)) == state
        bench.run(20)
        assert bench.status().state == state
        np.testing.assert_array_equal(bench.all_codes(), whole)
    assert state_of(paused.ask(Resume())) == State.PLAYING
    paused.run(20)
    assert paused.status().state == State.FINISHED
    np.testing.assert_array_equal(paused.all_codes(), whole)


def test_watchdog_in_the_last_ramp_stays() -> None:
    played = stream(0.3)
    whole = rendered(played)
    bench = Bench(Settings(watchdog_ms=(len(whole) - FADE_CODES // 2) // 3))
    bench.start_all(played)
    bench.run(600, polling=False)
    assert bench.status().state == State.WATCHDOG
    np.testing.assert_array_equal(bench.all_codes(), whole)


def test_stop_after_the_end_stays_stopped() -> None:
    bench = Bench()
    bench.start_all(stream(0.3))
    bench.run(600)
    assert bench.status().state == State.FINISHED
    assert state_of(bench.ask(Stop())) == State.STOPPED
    bench.run(20)
    assert bench.status().state == State.STOPPED


def test_controller_that_captures_nothing_plays() -> None:
    bench = Bench(Settings(capture_samples=0))
    bench.start_all(stream(0.3))
    bench.run(600)
    assert bench.status().state == State.FINISHED
    np.testing.assert_array_equal(bench.all_codes(), rendered(stream(0.3)))
    answer = bench.ask(CaptureRead(Tap.DAC, 0, 10))
    assert isinstance(answer, CaptureData)
    assert (answer.offset, answer.data) == (answer.end, b"")


def loud() -> Stream:
    """A second of full drive."""
    played = stream(1.0, 1, "full scale")
    return replace(played, header=replace(played.header, gains=(1024.0,)))


@pytest.mark.slow
@pytest.mark.parametrize("played_ms", [25, 40, 100, 400])
def test_power_limit_holds_across_streams_and_restarts(played_ms: int) -> None:
    played, image = loud(), ModelImage(1, "tables", "1", "", mdct.built_in_tables()).pack()
    bench = Bench()
    write_image(bench, 0, image)
    timeline: list[np.ndarray] = []
    started_us = bench.now_us
    for stream_number in range(2500 // played_ms):
        if stream_number == 1:
            bench.ask(FlashActivate(0))
        bench.start_all(played, gain=1000.0, compensation=False)
        for _ in range(played_ms):
            bench.run(1)
            # Without new codes the DAC holds the last one, which is at rest.
            taken = sum(map(len, timeline))
            timeline += bench.codes
            bench.codes.clear()
            missing = 3 * (bench.now_us - started_us) // 1000 - sum(map(len, timeline))
            timeline.append(np.zeros((max(0, missing), 1), np.int16))
            assert sum(map(len, timeline)) <= taken + 3 + 2 * FADE_CODES
    power = np.concatenate(timeline)[:, 0].astype(float) ** 2 / 32768**2
    assert len(power) > 6000
    highest = max(np.mean(power[start : start + 3000]) for start in range(0, len(power) - 3000, 30))
    assert 0.01 < highest <= PIEZO_STACK.power_limit


def test_stream_after_a_limited_one_plays_as_computed_offline() -> None:
    played = loud()
    expected, counts = render(
        played.header, played.decoded, played.delay_samples, PIEZO_STACK, gain=1000.0, compensation=False
    )
    assert counts.power_limited > 1000
    bench = Bench()
    for _ in range(2):
        bench.start_all(played, gain=1000.0, compensation=False)
        bench.run(1300)
        assert bench.status().state == State.FINISHED
        np.testing.assert_array_equal(bench.captured(Tap.DAC), expected)


def test_gain_changes_along_a_ramp() -> None:
    played = stream()
    bench = Bench()
    bench.start_all(played)
    bench.run(300)
    bench.ask(Gain(0.25))
    bench.run(1000)
    codes = bench.captured(Tap.DAC)
    np.testing.assert_array_equal(codes[:900], rendered(played)[:900])
    np.testing.assert_array_equal(codes[1000:2900], rendered(played, gain=0.25)[1000:2900])


def test_live_stream_ends_where_the_host_says() -> None:
    played = replace(stream(), header=replace(stream().header, samples=None))
    bench = Bench()
    bench.configure(played, packets=0)
    bench.send(played, range(10))
    bench.ask(Start())
    bench.run(200)
    assert state_of(bench.ask(EndStream(7, 10))) == State.PLAYING
    assert error_code(bench.ask(Loop(2))) == ErrorCode.BAD_VALUE
    bench.run(800)
    assert bench.status().state == State.FINISHED
    assert bench.status().underruns == 0
    np.testing.assert_array_equal(bench.captured(Tap.DECODED), played.decoded[: 10 * played.packet_samples])


def test_live_stream_without_an_end_in_sight_stops_with_its_host() -> None:
    bench = Bench()
    bench.configure(stream(), packets=0)
    bench.ask(Start())
    assert state_of(bench.ask(EndStream(7, 2**32 - 1))) == State.ARMED
    bench.run(5000, polling=False)
    assert bench.status().state == State.WATCHDOG
    assert bench.status().underruns == 1


def test_first_packet_is_where_playing_begins() -> None:
    played = stream()
    refresh = next(number for number in range(1, 99) if played.packets[number][0] & 1)
    bench = Bench()
    bench.configure(played, first_packet=refresh)
    bench.send(played, range(len(played.packets)))
    bench.ask(Start())
    assert bench.status().position == refresh * played.packet_samples
    bench.run(1300)
    captured = bench.captured(Tap.DECODED)
    begin = refresh * played.packet_samples
    assert len(captured) == len(played.decoded) - begin
    # The first block lacks its overlap with the one before; all after it is whole.
    np.testing.assert_array_equal(captured[played.packet_samples :], played.decoded[begin + played.packet_samples :])


# ---- loss ----


def test_underrun_is_counted_once_faded_and_never_plays_old_samples() -> None:
    played = stream(2.0)
    bench = Bench()
    bench.configure(played)
    bench.send(played, range(8))
    bench.ask(Start())
    bench.run(700)
    status = bench.status()
    assert status.state == State.PLAYING
    assert status.underruns == 1
    assert any(isinstance(message, Status) and message.underruns == 1 for message in bench.notified)
    assert status.position > 8 * played.packet_samples
    # Stale packets are dropped, those to come are played from the next refresh on.
    bench.send(played, range(8, len(played.packets)))
    bench.run(1700)
    assert bench.status().state == State.FINISHED
    assert bench.status().underruns == 1
    assert bench.status().buffered_samples == 0
    captured = bench.captured(Tap.DECODED)
    assert len(captured) == len(played.decoded)
    starved_from = 8 * played.packet_samples
    np.testing.assert_array_equal(captured[:starved_from], played.decoded[:starved_from])
    silence = captured[starved_from + 2 * played.packet_samples : round(0.65 * RATE_HZ)]
    assert len(silence) > 200
    assert not silence.any()
    np.testing.assert_array_equal(captured[-RATE_HZ // 2 :], played.decoded[-RATE_HZ // 2 :])


def test_one_lost_packet_costs_at_most_until_the_next_refresh() -> None:
    played = stream(2.0)
    refreshes = [number for number, packet in enumerate(played.packets) if packet[0] & 1]
    lost = refreshes[2] + 1
    bench = Bench()
    bench.configure(played, prebuffer_samples=2800)
    bench.send(played, range(lost))
    bench.send(played, range(lost + 1, len(played.packets)))
    bench.ask(Start())
    bench.run(2300)
    assert bench.status().lost_packets == 1
    assert bench.status().underruns == 0
    captured = bench.captured(Tap.DECODED)
    begin, end = lost * played.packet_samples, (refreshes[3] + 1) * played.packet_samples
    np.testing.assert_array_equal(captured[:begin], played.decoded[:begin])
    np.testing.assert_array_equal(captured[end:], played.decoded[end:])
    assert np.abs(captured[begin:end].astype(int)).max() <= np.abs(played.decoded.astype(int)).max()


def test_order_and_copies_of_packets_do_not_matter() -> None:
    played = stream()
    numbers = [*range(len(played.packets)), *range(len(played.packets))]
    np.random.default_rng(4).shuffle(numbers)
    bench = Bench()
    bench.configure(played, prebuffer_samples=len(played.decoded))
    for number in numbers:
        bench.send(played, range(number, number + 1))
    bench.ask(Start())
    bench.run(1300)
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played))


def test_packets_beyond_credit_or_of_another_stream_are_dropped() -> None:
    played = stream(2.0)
    bench = Bench(SMALL)
    room_packets = SMALL.buffer_samples // played.packet_samples
    assert room_packets < len(played.packets)
    answer = bench.configure(played)
    assert isinstance(answer, Status)
    assert answer.credit_until == room_packets * played.packet_samples
    bench.send_payload(pack(StreamData(8, 0, played.packets[:3])))
    assert bench.status().buffered_samples == 0
    bench.send(played, range(len(played.packets)))
    assert bench.status().buffered_samples == room_packets * played.packet_samples


def test_silent_host_stops_the_output_within_the_watchdog() -> None:
    played = stream(2.0)
    bench = Bench(Settings(watchdog_ms=300))
    bench.start_all(played)
    bench.run(1900, polling=False)
    codes = bench.all_codes()
    assert 900 <= len(codes) <= 900 + FADE_CODES + 3
    np.testing.assert_array_equal(codes[:900], rendered(played)[:900])
    assert not codes[-1].any()
    assert bench.status().state == State.WATCHDOG


@pytest.mark.parametrize(
    ("sent", "state"),
    [
        (write_frame(pack(StreamData(9, 0, ()))), State.PLAYING),
        (write_frame(bytes([StreamData.TYPE])), State.PLAYING),
        (write_frame(pack(StreamData(9, 0, ())))[:-2] + b"\xee\0", State.WATCHDOG),
        (b"\x07noise\0", State.WATCHDOG),
        (b"\0\0", State.WATCHDOG),
    ],
    ids=["stream data", "unreadable", "damaged", "noise", "zeros"],
)
def test_whole_frames_alone_are_a_sign_of_life(sent: bytes, state: State) -> None:
    bench = Bench(Settings(watchdog_ms=300))
    bench.start_all(stream(2.0))
    for _ in range(10):
        bench.run(100, polling=False)
        bench.controller.receive(sent, bench.now_us)
    assert bench.status().state == state


def test_watchdog_also_stops_what_one_long_step_of_time_skips() -> None:
    bench = Bench(Settings(watchdog_ms=300))
    bench.start_all(stream(2.0))
    bench.now_us += 3600 * 1_000_000
    assert bench.status().state == State.WATCHDOG
    assert len(bench.all_codes()) <= 900 + FADE_CODES + 3


@pytest.mark.parametrize("later_us", [2**32, 2**63, 2**64 - 3_000_000])
@pytest.mark.parametrize("requests", [(), (Start(2**64 - 1),), (Start(),), (Start(), Pause())])
def test_no_jump_of_the_clock_is_too_long(requests: tuple[Message, ...], later_us: int) -> None:
    played = stream(0.3)
    bench = Bench()
    bench.configure(stream(2.0), loops=0)
    bench.send(stream(2.0), range(len(stream(2.0).packets)))
    for request in requests:
        bench.ask(request)
        bench.run(20)
    bench.now_us += later_us
    bench.controller.advance(bench.now_us)
    assert bench.status().state == (State.WATCHDOG if requests else State.BUFFERING)
    assert bench.status().device_time_us == bench.now_us
    assert not bench.all_codes()[-1:].any()
    bench.codes.clear()
    bench.start_all(played)
    bench.run(600)
    assert bench.status().state == State.FINISHED
    np.testing.assert_array_equal(bench.all_codes(), rendered(played))


def test_status_is_notified_while_playing_and_on_changes() -> None:
    bench = Bench()
    bench.start_all(stream())
    bench.run(1300, polling=False)
    bench.collect()
    states = [message.state for message in bench.notified if isinstance(message, Status)]
    assert states.count(State.PLAYING) >= 9
    assert states[-1] == State.FINISHED


def test_capture_keeps_the_newest_and_says_from_where() -> None:
    played = stream()
    bench = Bench(SMALL)
    bench.start_all(played)
    bench.run(1300)
    answer = bench.ask(CaptureRead(Tap.DECODED, 0, 100))
    assert isinstance(answer, CaptureData)
    assert (answer.offset, answer.end) == (len(played.decoded) - SMALL.capture_samples, len(played.decoded))
    assert answer.data == played.decoded[answer.offset : answer.offset + 100].astype("<i2").tobytes()
    beyond = bench.ask(CaptureRead(Tap.DECODED, 1 << 60, 100))
    assert isinstance(beyond, CaptureData)
    assert (beyond.offset, beyond.data) == (len(played.decoded), b"")


def test_clock_runs_fast_by_its_drift() -> None:
    bench = Bench(Settings(drift_ppm=200))
    bench.ask(Hello())
    bench.now_us += 100_000_000
    assert bench.status().device_time_us == 100_020_000


# ---- model images ----


def write_image(bench: Bench, slot: int, image: bytes) -> None:
    bench.ask(Hello())
    begun = bench.ask(FlashBegin(slot, len(image), sha256(image), "simulated"))
    assert isinstance(begun, FlashStatus)
    for offset in range(begun.next_offset, len(image), 1000):
        written = bench.ask(FlashData(slot, offset, image[offset : offset + 1000]))
        assert isinstance(written, FlashStatus)
    assert isinstance(bench.ask(FlashVerify(slot)), FlashStatus)


def flash_image(bench: Bench, slot: int, image: bytes) -> None:
    write_image(bench, slot, image)
    assert isinstance(bench.ask(FlashActivate(slot)), FlashStatus)


def test_restart_in_the_middle_of_a_ramp_brings_the_output_to_rest() -> None:
    bench = Bench(Settings(watchdog_ms=300))
    write_image(bench, 0, ModelImage(1, "tables", "1", "", mdct.built_in_tables()).pack())
    bench.start_all(stream(2.0))
    while bench.controller.transmit() is not None and len(bench.all_codes()) <= 900:
        bench.now_us += 300
        bench.controller.advance(bench.now_us)
    assert bench.all_codes()[-1].any()
    assert isinstance(bench.ask(FlashActivate(0)), FlashStatus)
    assert not bench.all_codes()[-1].any()
    assert len(bench.all_codes()) == 900 + FADE_CODES


def test_flashed_image_decodes_the_streams_that_name_it() -> None:
    image = ModelImage(1, "tables", "1", "", mdct.built_in_tables()).pack()
    bench = Bench()
    flash_image(bench, 1, image)
    assert error_code(bench.ask(StatusRequest())) == ErrorCode.HELLO_FIRST
    hello = bench.ask(Hello())
    assert isinstance(hello, HelloResponse)
    assert hello.images[1].state == SlotState.TESTING
    confirmed = bench.ask(FlashConfirm(1))
    assert isinstance(confirmed, FlashStatus)
    assert confirmed.state == SlotState.CONFIRMED
    played = replace(stream(), header=replace(stream().header, image_hash=sha256(image)[:IMAGE_HASH_BYTES]))
    bench.start_all(played)
    bench.run(1300)
    np.testing.assert_array_equal(bench.captured(Tap.DECODED), played.decoded)


def test_an_image_under_test_says_how_the_test_ends() -> None:
    first, second = (ModelImage(1, name, "1", "", mdct.built_in_tables()).pack() for name in ("first", "second"))
    bench = Bench()
    flash_image(bench, 0, first)
    bench.ask(Hello())
    bench.ask(FlashConfirm(0))
    flash_image(bench, 1, second)
    bench.ask(Hello())
    for request in (FlashActivate(0), FlashActivate(1), *(FlashBegin(slot, 100, bytes(32), "") for slot in (0, 1))):
        answer = bench.ask(request)
        assert error_code(answer) == ErrorCode.WRONG_STATE
        assert "slot 1 is being tested: confirm it, or switch the controller off and on" in str(answer)


def test_flashing_is_rejected_while_playing() -> None:
    bench = Bench()
    bench.start_all(stream())
    bench.run(10)
    assert error_code(bench.ask(FlashBegin(0, 100, bytes(32), ""))) == ErrorCode.WRONG_STATE
    assert error_code(bench.ask(FlashActivate(0))) == ErrorCode.WRONG_STATE


def test_flash_that_fails_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    bench = Bench(flash=FlashMemory(FLASH_BYTES, path=path))
    bench.ask(Hello())
    path.unlink()
    assert error_code(bench.ask(FlashBegin(0, 100, bytes(32), ""))) == ErrorCode.FLASH_FAILED
    assert isinstance(bench.ask(StatusRequest()), Status)


def test_rejection_that_quotes_the_host_still_fits_a_frame() -> None:
    bench = Bench()
    bench.ask(Hello())
    assert error_code(bench.ask(FlashBegin(0, 100, bytes(32), "x" * 4050))) == ErrorCode.WRONG_HARDWARE


# ---- hostile bytes ----


def any_streams() -> st.SearchStrategy[bytes]:
    """Configure messages in which samples, packets, their blocks and the loops vary together."""

    def packed(
        samples: int | None, blocks: int, hop: int, packets: int, loops: int, rate_hz: int, unit: str, channels: int
    ) -> bytes:
        header = StreamHeader(1, rate_hz, samples, unit, (1.0,) * channels, configuration(blocks, hop, channels))
        return pack(Configure(7, header.pack(), 0, packets=packets, loops=loops), 1)

    return st.builds(
        packed,
        st.none() | st.integers(0, 40) | st.integers(0, 5000),
        st.integers(1, 6) | st.integers(1, 512),
        st.sampled_from(mdct.HOPS),
        st.integers(0, 5),
        st.sampled_from([0, 1, 2, 65_535]),
        st.sampled_from([100, 2800, 48_000]),
        st.sampled_from(UNITS),
        st.integers(1, 3),
    )


def hostile_payloads() -> st.SearchStrategy[bytes]:
    types = st.sampled_from([message.TYPE for message in ALL] + [0, 0x3F, 0x7F, 0xFE])
    fuzzed = st.builds(
        lambda kind, sequence, body: bytes([kind]) + sequence.to_bytes(2, "little") + body,
        types,
        st.integers(0, 9) | st.integers(0, 0xFFFF),
        st.binary(max_size=60),
    )
    played = stream()
    valid = st.builds(
        pack,
        st.sampled_from(
            [
                Hello(),
                Configure(7, played.header.pack(), 0, packets=len(played.packets), loops=2),
                Configure(7, played.header.pack(), 99, packets=0),
                StreamData(7, 0, played.packets),
                StreamData(7, 1, played.packets),
                StreamData(7, 0, tuple(packet[:1] + packet[:0:-1] for packet in played.packets)),
                *(Start(at_us) for at_us in (0, 30_000, 2**64 - 1)),
                *(Gain(gain) for gain in (0.0, 3e38)),
                *(Loop(loops) for loops in (0, 1, 65535)),
                Pause(),
                Resume(),
                Stop(),
                EndStream(7, 3),
                CaptureRead(Tap.DAC, 2**64 - 1, 65535),
                FlashBegin(1, 100, bytes(32), ""),
                FlashData(1, 0, bytes(50)),
                FlashVerify(1),
                FlashActivate(1),
            ]
        ),
        st.integers(1, 0xFFFF),
    )
    altered = st.builds(
        lambda payload, at, byte: payload[: 3 + at % len(payload)] + bytes([byte]) + payload[4 + at % len(payload) :],
        valid,
        st.integers(0, 60),
        st.integers(0, 255),
    )
    return valid | altered | fuzzed | any_streams() | st.binary(min_size=1, max_size=80)


@settings(max_examples=80, deadline=None)
@given(
    st.lists(
        st.tuples(hostile_payloads(), st.integers(0, 80_000), st.booleans(), st.binary(max_size=5)),
        min_size=5,
        max_size=40,
    )
)
def test_hostile_bytes_never_raise_and_never_pass_the_limits(
    pieces: list[tuple[bytes, int, bool, bytes]],
) -> None:
    codes: list[np.ndarray] = []
    controller = Controller(on_dac=codes.append)
    controller.receive(write_frame(pack(Hello(), 1)), 0)
    now_us = 0
    for payload, wait_us, framed, noise in pieces:
        now_us += wait_us
        controller.receive((write_frame(payload) if framed else payload) + noise, now_us)
    controller.advance(now_us + 10_000_000)
    assert len(controller.transmit()) < 200_000
    for piece in codes:
        steps = np.abs(np.diff(piece.astype(int), axis=0))
        assert steps.max(initial=0) <= PIEZO_STACK.code_step_limit
    assert not codes or not codes[-1][-1].any()
    controller.receive(
        b"\0" + write_frame(pack(Hello(), 60_000)) + write_frame(pack(Stop(), 60_001)), now_us + 20_000_000
    )
    assert controller.transmit()


@settings(max_examples=60)
@given(any_streams(), st.lists(st.sampled_from([0, 1, 2, 65_535]), max_size=2), st.booleans())
def test_no_stream_keeps_the_controller_from_going_on(configured: bytes, loops: list[int], polling: bool) -> None:
    bench = Bench(Settings(watchdog_ms=300))
    bench.ask(Hello())
    bench.sequence += 1
    bench.send_payload(configured[:1] + bench.sequence.to_bytes(2, "little") + configured[3:])
    bench.ask(Start())
    for count in loops:
        bench.ask(Loop(count))
    bench.run(400, polling)
    if not polling:
        assert bench.status().state not in (State.ARMED, State.PLAYING)
    assert state_of(bench.ask(Stop())) == State.STOPPED
    codes = bench.all_codes()
    assert len(codes) <= 3 * 400 + FADE_CODES
    assert not codes[-1:].any()


def test_host_that_never_reads_fills_no_memory() -> None:
    controller = Controller()
    request = b"".join(write_frame(pack(Hello(), sequence)) for sequence in range(1, 5000))
    controller.receive(request, 0)
    assert len(controller.transmit()) < 140_000


def test_every_request_is_answered() -> None:
    examples = {Hello: Hello(), StatusRequest: StatusRequest(), Stop: Stop()}
    bench = Bench()
    bench.ask(Hello())
    for request in REQUESTS:
        if request in examples:
            assert not isinstance(bench.ask(examples[request]), Error)
        else:
            (answer,) = bench.send_payload(bytes([request.TYPE]) + (bench.sequence + 1).to_bytes(2, "little"))
            bench.sequence += 1
            assert isinstance(answer[1], Error)
