"""The firmware on emulated boards: it plays every codec as computed, keeps images, reports faults; its stack."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import unicorn
from unicorn import arm_const

from tests.firmware.boards import (
    BOARDS,
    LEARNED,
    PIEZO_12_BITS,
    begin,
    between_rests,
    board,
    coded,
    flash_of,
    play_as_computed,
    rate_controlled,
    session,
)
from tests.simulated_device.test_profile import coded as coded_profile
from vibrocast import models
from vibrocast.device_protocol import messages
from vibrocast.device_protocol.frames import write_frame
from vibrocast.firmware.build import build
from vibrocast.firmware.elf import Elf
from vibrocast.harness.boards import stm32f405
from vibrocast.harness.boards.cortex_m import CORES, CortexM
from vibrocast.harness.boards.emulator import EmulationError
from vibrocast.harness.boards.rp2040 import Rp2040
from vibrocast.harness.boards.stm32f405 import Stm32F405
from vibrocast.host import uploader
from vibrocast.host.controller import Controller as Host
from vibrocast.output.actuator import PIEZO_STACK, Codes
from vibrocast.output.rendering import render
from vibrocast.simulated_device.memory_link import MemoryLink

START_US, BOARD_DAC_HZ = 300_000, 3000


@pytest.mark.parametrize(
    ("name", "codec_name"),
    [
        *((name, "mdct") for name in (*CORES, *BOARDS)),
        *(
            pytest.param(name, codec_name, marks=pytest.mark.slow)
            for name in ("cortex-m4", *BOARDS)
            for codec_name in ("dct", "slp", "eva", "parametric")
        ),
    ],
)
def test_streams_are_played_as_computed_within_the_stack(name: str, codec_name: str) -> None:
    """On the board, and on the other cores, rate-controlled ones where the codec controls its rate."""
    codes: list[Codes] = []
    device = board(name, on_dac=codes.append)
    link, host = session(device)
    controlled = name not in ("cortex-m4", "rp2040") and codec_name in ("mdct", "dct", "slp", "eva")
    stream = rate_controlled(codec_name) if controlled else coded(codec_name)
    if stream.image is not None:
        uploader.flash(host, stream.image)
    actuator = replace(PIEZO_STACK, dac_bits=host.description.actuator.dac_bits)
    expected = play_as_computed(link, host, stream, actuator)
    np.testing.assert_array_equal(between_rests(np.concatenate(codes)), between_rests(expected))
    # Three quarters of the smaller stack: other streams may need the rest.
    assert 500 < device.processor.stack_bytes() < 6144
    if isinstance(device, Rp2040):
        assert 0 < device.latest_level_ticks < 5000, "each level is there before the next period of the PWM"


@pytest.mark.slow
@pytest.mark.parametrize("name", [*CORES, "stm32f405"])
def test_images_outlive_a_restart(name: str) -> None:
    flash = flash_of(name)
    kept = uploader.flash(session(board(name, flash))[1], models.find(LEARNED).image)
    _, host = session(board(name, flash))
    running = uploader.running(host)
    assert running is not None
    assert (running.slot, running.sha256) == (kept.slot, kept.sha256)


@pytest.mark.parametrize("name", BOARDS)
def test_the_board_rests_in_the_middle_from_the_first_moment(name: str) -> None:
    codes: list[Codes] = []
    device = board(name, on_dac=codes.append)
    for now_us in range(0, 200_000, 1000):
        device.advance(now_us)
    assert len(np.concatenate(codes)) == pytest.approx(0.2 * BOARD_DAC_HZ, abs=15)
    assert not np.concatenate(codes).any()


def slow_down(device: Stm32F405, function: str, milliseconds: list[int]) -> None:
    """Make each call of a function take its time, and all further ones the last time: interrupts come in its midst."""
    address = Elf(build("stm32f405")).symbols[function] & ~1

    def pass_time(emulator: object, where: int, size_bytes: int, context: object) -> None:
        device.processor.counter.add_cycles(
            168_000 * (milliseconds.pop(0) if len(milliseconds) > 1 else milliseconds[0])
        )

    device.processor.unicorn.hook_add(unicorn.UC_HOOK_CODE, pass_time, None, address, address)


def played_by_board(
    decoding_ms: list[int],
    meanwhile: Callable[[Host, MemoryLink], None] = lambda host, link: None,
    stall_ms: list[int] | None = None,
) -> tuple[Codes, Codes, Codes]:
    """Play a stream from 0.3 s on; return its codes, the DAC's from that time on, and those captured.

    `decoding_ms`: of each block of a channel; `meanwhile`: what a host does 0.1 s later; `stall_ms`: by each message
    then.
    """
    codes: list[Codes] = []
    device = Stm32F405(on_dac=codes.append)
    stalls = [0]
    slow_down(device, "vc_mdct_poll", decoding_ms)
    slow_down(device, "vc_message_read", stalls)
    link, host = session(device)
    stream = coded("mdct", seconds=0.6)
    begin(host, stream, START_US)
    link.sleep((START_US - link.now_us) / 1e6 + 0.1)
    host.send(messages.StreamData(1, 0, stream.packets[12:]))
    stalls[:] = [*(stall_ms or []), 0]
    meanwhile(host, link)
    link.sleep(1.0)
    expected, _ = render(stream.header, stream.decode_integers(), stream.delay_samples, PIEZO_12_BITS)
    pieces, end = [b""], 1
    while (offset := sum(map(len, pieces)) // 4) < end:
        captured = host.request(messages.CaptureRead(messages.Tap.DAC, offset, 500), messages.CaptureData)
        pieces, end = [*pieces, captured.data], captured.end
    played = np.concatenate(codes)[1 + START_US * BOARD_DAC_HZ // 1_000_000 :]
    return expected, played, np.frombuffer(b"".join(pieces), "<i2").reshape(-1, 2)


def ask_often(host: Host, link: MemoryLink) -> None:
    for _ in range(4):
        host.request_status()
        link.sleep(0.1)


def check_that_it_faded(expected: Codes, played: Codes, last_samples: int, most_lag_ms: float) -> None:
    """Check that the last samples are those of the stream, so late, and that nothing jumped before."""
    end = np.flatnonzero(played.any(axis=1))[-1] + 1
    assert len(expected) < end <= len(expected) + most_lag_ms * BOARD_DAC_HZ / 1000
    np.testing.assert_array_equal(played[end - last_samples : end], between_rests(expected)[-last_samples:])
    step = np.abs(np.diff(expected.astype(int), axis=0)).max()
    assert np.abs(np.diff(played.astype(int), axis=0)).max() <= step + 4096 // 100
    moving = np.flatnonzero(played.any(axis=1))
    begins = moving[1:][np.diff(moving) > 20]
    assert np.abs(played[begins]).max(initial=0) < 4096 // 100


@pytest.mark.slow
@pytest.mark.parametrize(("decoding_ms", "least_ms", "most_ms"), [(0, 3, 7), (1, 7, 11), (2, 11, 15), (4, 19, 23)])
def test_the_board_lags_by_what_decoding_needs(decoding_ms: int, least_ms: int, most_ms: int) -> None:
    expected, played, _ = played_by_board([decoding_ms])
    lag = np.flatnonzero(played.any(axis=1))[0] - np.flatnonzero(expected.any(axis=1))[0]
    assert least_ms <= lag * 1000 / BOARD_DAC_HZ <= most_ms
    np.testing.assert_array_equal(played[lag : lag + len(expected)], expected)
    assert not played[lag + len(expected) :].any()


def test_the_board_fades_out_and_in_where_decoding_takes_far_longer_than_at_first() -> None:
    check_that_it_faded(*played_by_board([1, 1, 1, 120, 1])[:2], 600, most_lag_ms=250)


def test_the_board_plays_on_later_after_its_loop_stood_still() -> None:
    check_that_it_faded(*played_by_board([1], ask_often, [300])[:2], 300, most_lag_ms=4 + 2 * 310)


def test_the_board_gets_used_to_short_stalls() -> None:
    """Only the first one is felt."""
    check_that_it_faded(*played_by_board([0], ask_often, [6, 6, 6, 6])[:2], 1200, most_lag_ms=4 + 2 * 13)


def test_the_board_goes_on_after_a_pause_with_the_lag_that_it_needs() -> None:
    def pause(host: Host, link: MemoryLink) -> None:
        host.request(messages.Pause(), messages.Status)
        link.sleep(0.2)
        host.request(messages.Resume(), messages.Status)

    _, played, captured = played_by_board([5], pause)
    np.testing.assert_array_equal(played[played.any(axis=1)], captured[captured.any(axis=1)])


@pytest.mark.parametrize("decoding_ms", [1, 5])
def test_a_stop_reaches_the_register_at_once(decoding_ms: int) -> None:
    stopped_us = []

    def stop(host: Host, link: MemoryLink) -> None:
        stopped_us.append(link.now_us - START_US)
        host.request(messages.Stop(), messages.Status)

    expected, played, captured = played_by_board([decoding_ms], stop)
    lag = np.flatnonzero(played.any(axis=1))[0] - np.flatnonzero(expected.any(axis=1))[0]
    as_expected = (played[lag : lag + len(expected)] == expected[: len(played) - lag]).all(axis=1)
    way_down = lag + np.flatnonzero(~as_expected)[0]
    late_us = way_down * 1_000_000 // BOARD_DAC_HZ - stopped_us[0]
    assert 0 <= late_us < 1000 * (decoding_ms + 3)
    level = np.abs(played[way_down - 1 :].astype(int))
    assert np.all(np.diff(level, axis=0) <= 12), "on its way to rest"
    assert len(captured) < len(expected)


@pytest.mark.parametrize("name", BOARDS)
def test_the_output_rests_within_30_ms_of_a_stop(name: str) -> None:
    codes: list[Codes] = []
    link, host = session(board(name, on_dac=codes.append))
    begin(host, coded("mdct", seconds=1.0))
    link.sleep(0.4)
    before = len(np.concatenate(codes))
    host.request(messages.Stop(), messages.Status)
    link.sleep(0.2)
    level = np.concatenate(codes)[before:]
    moving = np.flatnonzero(level.any(axis=1))
    assert 0 < moving[-1] <= 30 * BOARD_DAC_HZ // 1000


@pytest.mark.parametrize(("name", "interrupt"), [("stm32f405", stm32f405._TIM6), ("rp2040", 16 + 4)])
def test_the_board_comes_to_rest_when_its_loop_stands_still(name: str, interrupt: int) -> None:
    """Only the DAC's interrupt goes on, in the midst of a stream: what is there is played, then the output let down."""
    codes: list[Codes] = []
    device = board(name, on_dac=codes.append)
    assert isinstance(device, Stm32F405 | Rp2040)
    link, host = session(device)
    stream = coded("mdct", seconds=1.0)
    begin(host, stream)
    link.sleep(0.35)
    before = len(np.concatenate(codes))
    for _ in range(1500):
        device._interrupt(interrupt)
    device.advance(link.now_us)
    level = np.concatenate(codes)[before:]
    assert level[:100].any()
    assert not level[-900:].any()
    at_rest = np.flatnonzero(level.any(axis=1))[-1]
    way_down = np.abs(np.diff(level[at_rest - 3 : at_rest + 2].astype(int), axis=0))
    assert way_down.max() <= 4096 // 100


def test_what_a_host_does_not_read_stays_bounded() -> None:
    device = CortexM("cortex-m4")
    device.receive(b"".join(write_frame(messages.pack(messages.Hello(), n)) for n in range(5, 2000)), 0)
    assert 0 < len(device.transmit()) < 100_000


def test_image_that_a_processor_would_stop_is_an_error_that_says_where() -> None:
    device = CortexM("cortex-m4")
    device.processor.unicorn.reg_write(arm_const.UC_ARM_REG_PC, 0x6000_0000)
    with pytest.raises(EmulationError, match=r"stopped at 0x6.*: there is nothing at 0x60000000"):
        device.advance(1000)


def test_bytes_wait_no_longer_than_for_a_block_while_a_profile_is_loaded() -> None:
    device = Stm32F405()
    link, host = session(device)
    profile = coded_profile(2)
    host.request(messages.Configure(1, profile.header.pack(), 0, packets=len(profile.packets)), messages.Status)
    for packet in profile.packets:
        host.send(messages.StreamData(1, 0, (packet,)))
        link.sleep(0.02)
    assert device.longest_turn_us() < 2500
    host.request(messages.Start(0), messages.Status)
    link.sleep(0.1)
    assert host.request(messages.StatusRequest(), messages.Status).state == messages.State.PLAYING
