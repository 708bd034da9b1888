"""The controller in simulated time, beyond its conformance: exact ramps, jumps of the clock, hostile bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.simulated_device.bench import RATE_HZ, Bench, Stream, stream
from vibrocast.codec import Framing, SignalFormat, core, dct, mdct
from vibrocast.device_protocol.coded_stream import UNITS, StreamHeader
from vibrocast.device_protocol.frames import write_frame
from vibrocast.device_protocol.messages import (
    ALL,
    CaptureRead,
    Configure,
    EndStream,
    Error,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashData,
    FlashStatus,
    FlashVerify,
    Gain,
    Hello,
    Loop,
    Message,
    Pause,
    Resume,
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
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.rendering import FADE_SECONDS, render
from vibrocast.simulated_device.controller import FLASH_BYTES, Controller, Settings
from vibrocast.simulated_device.flash import FlashMemory

FADE_CODES = round(FADE_SECONDS * PIEZO_STACK.dac_rate_hz)


def configuration(blocks: int, hop: int, channels: int = 1) -> bytes:
    """A stream's codec configuration with packets of `blocks` blocks of `hop` samples."""
    return mdct.configuration(hop, blocks, [600] * channels)


def rendered(played: Stream, gain: float = 1.0, loops: int = 1) -> np.ndarray:
    codes, _ = render(played.header, played.decoded, played.delay_samples, PIEZO_STACK, gain=gain, loops=loops)
    return codes


def error_code(answer: Message) -> int:
    assert isinstance(answer, Error)
    assert answer.text
    return answer.code


def state_of(answer: Message) -> State:
    assert isinstance(answer, Status)
    return answer.state


def test_configure_rejects_packets_that_the_buffer_cannot_hold_and_blocks_that_only_hosts_decode() -> None:
    bench = Bench()
    header = stream().header
    short_packets = replace(header, samples=None, configuration=configuration(1, 16))
    long_packets = replace(header, samples=None, configuration=configuration(1000, 64))
    bench.ask(Hello())
    for rejected in (
        # 1024 packets is what the buffer holds, of 16 samples each; in longer ones, what fits into its samples.
        Configure(1, short_packets.pack(), 16 * 1024 + 1),
        Configure(1, long_packets.pack(), 0),
    ):
        assert error_code(bench.ask(rejected)) == ErrorCode.BEYOND_LIMITS
    whole = dct.DctEncoder(
        dct.CODEC.complete({"block": "whole"}), SignalFormat(RATE_HZ, "um", (1.0,), (0.5,), 560), Framing(560, 0)
    ).configuration
    answer = bench.ask(Configure(1, StreamHeader(dct.IDENTIFIER, RATE_HZ, 560, "um", (1.0,), whole).pack(), 0))
    assert error_code(answer) == ErrorCode.UNKNOWN_CODEC
    assert "only hosts decode: encode in blocks" in str(answer)


def test_the_dac_gets_the_codes_that_are_captured_in_all_channels_and_for_any_steps_of_time() -> None:
    played = stream(1.0, 16)
    bench = Bench(Settings(channels=16))
    bench.start_all(played, gain=0.5)
    rng = np.random.default_rng(3)
    while bench.now_us < 1_300_000:
        bench.now_us += int(rng.integers(1, 60_000))
        bench.status()
    np.testing.assert_array_equal(bench.captured(Tap.DECODED), played.decoded)
    np.testing.assert_array_equal(bench.captured(Tap.DAC), rendered(played, gain=0.5))
    np.testing.assert_array_equal(bench.all_codes(), rendered(played, gain=0.5))


def test_each_frame_out_of_turn_counts_once_also_after_its_time() -> None:
    bench, played = Bench(), stream()
    bench.configure(played)
    packets = played.packets

    def counts(*frames: slice) -> tuple[int, int]:
        for part in frames:
            bench.send_payload(pack(StreamData(7, 0, packets[part])))
        return bench.status().repeated_frames, bench.status().reordered_frames

    assert counts(slice(0, 3), slice(3, 6)) == (0, 0)
    assert counts(slice(3, 6), slice(0, 3)) == (2, 0)
    assert counts(slice(8, 10), slice(6, 8)) == (2, 1)
    bench.ask(Start())
    bench.run(round(1e3 * 11 * played.packet_samples / RATE_HZ))  # two packets are late
    assert counts(slice(9, 10)) == (3, 1)
    assert counts(slice(10, 11), slice(10, 11)) == (4, 1)
    assert counts(slice(3, 4)) == (4, 2)
    bench.configure(played)
    assert counts(slice(0, 3)) == (4, 2)


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


def test_pause_and_resume_cost_the_output_one_fade_and_no_sample() -> None:
    played = stream()
    bench = Bench()
    bench.start_all(played)
    bench.run(300)
    bench.ask(Pause())
    bench.run(500)
    bench.ask(Resume())
    bench.run(1300)
    whole, paused = rendered(played), bench.captured(Tap.DAC)
    assert len(paused) == len(whole) + FADE_CODES
    resumed_at = 900 + FADE_CODES
    np.testing.assert_array_equal(paused[:900], whole[:900])
    np.testing.assert_array_equal(paused[resumed_at + FADE_CODES :], whole[900 + FADE_CODES :])


def test_stop_pause_and_watchdog_in_the_last_ramp_keep_their_state() -> None:
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

    silent = Bench(Settings(watchdog_ms=in_ramp_ms))
    silent.start_all(played)
    silent.run(600, polling=False)
    assert silent.status().state == State.WATCHDOG
    np.testing.assert_array_equal(silent.all_codes(), whole)


def loud() -> Stream:
    """A second of full drive."""
    played = stream(1.0, 1, "full scale")
    return replace(played, header=replace(played.header, gains=(1024.0,)))


def test_a_start_waits_until_the_power_limit_has_recovered() -> None:
    bench = Bench()
    bench.start_all(loud(), gain=1000.0, compensation=False)
    bench.run(800)
    assert bench.status().power_limited > 100
    bench.ask(Stop())
    bench.start_all(loud(), gain=1000.0, compensation=False)
    bench.run(20)
    assert bench.status().state == State.ARMED
    bench.run(300)
    assert bench.status().state == State.PLAYING


@pytest.mark.parametrize("played_ms", [25, 400])
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


def test_an_output_that_fails_ramps_to_rest_and_says_so() -> None:
    bench = Bench()
    bench.start_all(stream(2.0))
    bench.run(500)
    bench.controller.output_fault.set()
    bench.run(500)
    assert bench.status().state == State.FAULT
    codes = bench.all_codes()
    assert len(codes) <= 1500 + FADE_CODES + 3
    assert codes[1400].any() and not codes[-1].any()


@pytest.mark.parametrize(("step_us", "least_codes"), [(1000, 900), (3600 * 1_000_000, 0)])
def test_silent_host_stops_the_output_within_the_watchdog_however_time_passes(step_us: int, least_codes: int) -> None:
    bench = Bench(Settings(watchdog_ms=300))
    bench.start_all(stream(2.0))
    while bench.now_us < 2_000_000:
        bench.now_us += step_us
        bench.controller.advance(bench.now_us)
    codes = bench.all_codes()
    assert least_codes <= len(codes) <= 900 + FADE_CODES + 3
    np.testing.assert_array_equal(codes[:least_codes], rendered(stream(2.0))[:least_codes])
    assert not codes[-1].any()
    assert bench.status().state == State.WATCHDOG


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


def write_image(bench: Bench, slot: int, image: bytes) -> None:
    bench.ask(Hello())
    begun = bench.ask(FlashBegin(slot, len(image), sha256(image), "simulated"))
    assert isinstance(begun, FlashStatus)
    for offset in range(begun.next_offset, len(image), 1000):
        written = bench.ask(FlashData(slot, offset, image[offset : offset + 1000]))
        assert isinstance(written, FlashStatus)
    assert isinstance(bench.ask(FlashVerify(slot)), FlashStatus)


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


def test_flash_that_fails_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "flash.bin"
    bench = Bench(flash=FlashMemory(FLASH_BYTES, path=path))
    bench.ask(Hello())
    path.unlink()
    assert error_code(bench.ask(FlashBegin(0, 100, bytes(32), ""))) == ErrorCode.FLASH_FAILED
    assert isinstance(bench.ask(StatusRequest()), Status)


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
        st.sampled_from(core.HOPS),
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
