"""Faults between a real host and the controller, in simulated time: never garbage, never a hang, always an end."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import linked, session
from tests.simulated_device.bench import RATE_HZ, Stream, stream
from vibrocast.codec import Decoded, mdct
from vibrocast.device_protocol.messages import SlotState, State
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.host.controller import ControllerError
from vibrocast.host.player import BUFFER_S, PlaybackResult, PlaybackSettings, Progress, play
from vibrocast.host.uploader import flash
from vibrocast.output.actuator import PIEZO_STACK, Codes
from vibrocast.output.rendering import (
    Dac,
    Drive,
    recording_end,
    render,
)
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.flash import FlashMemory, PowerCut
from vibrocast.simulated_device.memory_link import MemoryLink

REFRESH_S = 0.25


class Desk:
    """A host, a wire and a controller; `codes` is all that went to the DAC."""

    def __init__(self, *faults: Fault, seed: int = 0, settings: Settings | None = None) -> None:
        self.codes: list[Codes] = []
        self.link, self.host = linked(settings, faults, seed, on_dac=self.codes.append)
        assert isinstance(self.link.controller, FaultyWire)
        self.wire = self.link.controller

    def all_codes(self) -> Codes:
        return np.concatenate(self.codes)


def play_on(at: Desk, played: Stream, **options: object) -> PlaybackResult:
    return play(at.host, played, PlaybackSettings(capture=True, **options))  # type: ignore[arg-type]


def assert_never_garbage(decoded: np.ndarray, played: Stream, lost_packets: int, loops: int = 1) -> None:
    """Every packet's time holds the clean samples, or no more than a fade of them up to the next refresh."""
    packets = len(played.packets)
    assert len(decoded) == loops * len(played.decoded)
    clean = played.decoded.reshape(packets, played.packet_samples, -1).astype(int)
    heard = decoded.reshape(loops * packets, played.packet_samples, -1).astype(int)
    refreshes = {number for number in range(len(heard)) if played.packets[number % packets][0] & 1}
    spoilt = [number for number in range(len(heard)) if not np.array_equal(clean[number % packets], heard[number])]
    assert len(spoilt) <= lost_packets * (round(REFRESH_S * RATE_HZ / played.packet_samples) + 1)
    # Half of a block, without the overlap of its lost neighbour: w^2 x + w v x' with w^2 + v^2 = 1 is at most
    # (1 + sqrt 2) / 2 of the loudest sample.
    loudest = 1.21 * np.abs(clean).max()
    for number in spoilt:
        assert np.abs(heard[number]).max() <= loudest
        overlap = played.delay_samples
        if number in refreshes and np.array_equal(clean[number % packets][overlap:], heard[number][overlap:]):
            continue  # sound begins again; only what overlaps with the lost packet is missing
        if number - 1 not in spoilt or number - 1 in refreshes:
            assert np.abs(heard[number][-8:]).max() <= loudest / 4  # the sound before, faded out
        else:
            assert not heard[number].any()


def assert_within_limits(codes: Codes) -> None:
    steps = np.abs(np.diff(codes.astype(int), axis=0, prepend=0))
    assert steps.max() <= PIEZO_STACK.code_step_limit
    assert not codes[-1].any()


def max_hold(codes: Codes) -> int:
    """Return the most DAC samples for which a channel has stayed where it was, other than at rest."""
    longest = 0
    for channel in codes.T:
        changes = np.flatnonzero(np.diff(channel, prepend=channel[0] - 1, append=channel[-1] - 1))
        held = channel[changes[:-1]] != 0
        longest = max(longest, int(np.diff(changes)[held].max(initial=0)))
    return longest


def output_of(decoded: Decoded, played: Stream, loops: int) -> Codes:
    """Return the codes that the output makes of any decoded samples."""
    drive = Drive(played.header, PIEZO_STACK, True, played.delay_samples)
    dac = Dac(played.header, PIEZO_STACK, 1.0, True, drive.drive_samples(played.delay_samples))
    end = recording_end(played.header, played.delay_samples)
    codes = []
    for number, heard in enumerate(np.split(decoded, loops)):
        if number > 0:
            drive.join()
        codes.append(dac.play(drive.push(heard[played.delay_samples if number > 0 else 0 : end])))
    return np.concatenate([*codes, dac.play(drive.finish()), dac.ramp_down()])


def test_four_channels_with_all_faults_have_no_wrong_sample_and_no_stuck_actuator() -> None:
    played = stream(10.0, 4)
    at = Desk(Fault(lost=0.01, flipped=0.01, doubled=0.05, swapped=0.05))
    result = play_on(at, played, loops=2)
    assert result.state == State.FINISHED
    assert result.decoded is not None
    assert 0 < result.lost_packets < 0.2 * len(played.packets)
    assert_never_garbage(result.decoded, played, result.lost_packets, 2)
    codes = at.all_codes()
    np.testing.assert_array_equal(codes, output_of(result.decoded, played, 2))
    assert_within_limits(codes)
    assert max_hold(codes) < 0.005 * PIEZO_STACK.dac_rate_hz


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 1000),
    lost=st.floats(0, 0.15),
    flipped=st.floats(0, 0.15),
    doubled=st.floats(0, 0.5),
    swapped=st.floats(0, 0.3),
)
def test_worse_lines_end_with_a_sound_output_or_a_clear_error(
    seed: int, lost: float, flipped: float, doubled: float, swapped: float
) -> None:
    played = stream(1.0)
    at = Desk(Fault(lost=lost, flipped=flipped, doubled=doubled, swapped=swapped), seed=seed)
    try:
        result = play_on(at, played)
    except ControllerError as error:
        assert str(error)
    else:
        assert result.state == State.FINISHED
        if result.reconnects == 0 and result.decoded is not None:
            assert_never_garbage(result.decoded, played, result.lost_packets)
    at.link.sleep(5.0)
    if at.codes:
        assert_within_limits(at.all_codes())


class PullCableOnce:
    """Pulls the cable when the playback comes to a position."""

    def __init__(self, wire: FaultyWire, at_s: float, out_s: float) -> None:
        self._wire, self._at_s, self._out_s = wire, at_s, out_s
        self.pulled = False

    def __call__(self, progress: Progress) -> None:
        if not self.pulled and progress.position_s >= self._at_s:
            self.pulled = True
            self._wire.change(Fault(cut=True, for_s=self._out_s))


@pytest.mark.parametrize("out_s", [0.1, 0.5, 4.0])
def test_a_pulled_cable_takes_nothing_from_the_recording(out_s: float) -> None:
    played = stream(6.0)
    at = Desk()
    cable = PullCableOnce(at.wire, 1.0, out_s)
    result = play_on(at, played, progress=cable)
    assert cable.pulled
    assert result.state == State.FINISHED
    assert result.reconnects == 1
    codes = at.all_codes()
    assert_within_limits(codes)
    assert result.decoded is not None
    clean, _ = render(played.header, played.decoded, played.delay_samples, PIEZO_STACK)
    until = round(0.9 * PIEZO_STACK.dac_rate_hz)
    np.testing.assert_array_equal(codes[:until], clean[:until])
    assert result.lost_packets == 0
    if out_s < BUFFER_S:
        np.testing.assert_array_equal(codes, clean)
        return
    # It goes on shortly before the place where the buffer ran out, with the samples after the codec's first ones.
    again = result.captured_from * played.packet_samples
    assert 0 < RATE_HZ + BUFFER_S * RATE_HZ - again < 0.5 * RATE_HZ
    np.testing.assert_array_equal(result.decoded[-RATE_HZ * 4 :], played.decoded[-RATE_HZ * 4 :])


def test_cable_that_stays_out_stops_the_output_and_ends_the_playback() -> None:
    at = Desk()
    with pytest.raises(OSError, match="cable"):
        play_on(at, stream(6.0), progress=PullCableOnce(at.wire, 1.0, 1e6), reconnect_s=3.0)
    at.link.sleep(3.0)
    codes = at.all_codes()
    assert_within_limits(codes)
    longest_s = 1.0 + Settings().watchdog_ms / 1000 + 0.5
    assert len(codes) < longest_s * PIEZO_STACK.dac_rate_hz


def test_killed_host_is_noticed_and_the_next_one_plays() -> None:
    class Killed(BaseException):
        pass

    def kill(progress: Progress) -> None:
        if progress.position_s > 1.0:
            at.wire.change(Fault(cut=True, for_s=0.001))  # not even a last Stop goes out
            raise Killed

    at = Desk()
    with pytest.raises(Killed):
        play_on(at, stream(6.0), progress=kill)
    at.link.sleep(Settings().watchdog_ms / 1000 + 0.1)
    codes = at.all_codes()
    assert_within_limits(codes)
    at.codes.clear()
    played = stream(1.0)
    at.host = session(at.link)
    result = play_on(at, played)
    assert result.state == State.FINISHED
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, played.decoded)


@pytest.mark.parametrize("drift_ppm", [-200, 200])
def test_credit_follows_the_clock_of_the_controller(drift_ppm: int) -> None:
    played = stream(5.0)
    result = play_on(Desk(settings=Settings(drift_ppm=drift_ppm)), played, loops=4)
    assert (result.state, result.underruns, result.lost_packets) == (State.FINISHED, 0, 0)
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, np.tile(played.decoded, (4, 1)))


OLD_IMAGE = ModelImage(1, "old", "1", "", mdct.built_in_tables()).pack()
NEW_IMAGE = ModelImage(1, "new", "2", "", mdct.built_in_tables()[::-1]).pack()


def flash_over(memory: FlashMemory, image: bytes) -> None:
    host = session(MemoryLink(Controller(flash=memory)))
    assert flash(host, image, slot=1 if image == NEW_IMAGE else 0).state == SlotState.CONFIRMED


def small_flash() -> FlashMemory:
    slot_bytes = -(-len(OLD_IMAGE) // 256) * 256
    return FlashMemory(2 * 256 + 2 * slot_bytes, sector_bytes=256)


def test_power_cut_while_a_host_flashes_leaves_the_old_image_running() -> None:
    memory = small_flash()
    flash_over(memory, OLD_IMAGE)
    before = copy.deepcopy(memory)
    memory.cut_after_bytes = 1 << 30
    flash_over(memory, NEW_IMAGE)
    session_bytes = (1 << 30) - memory.cut_after_bytes
    # Every byte is cut at in test_flash.py; here some of them, through the whole protocol.
    for cut_after_bytes in np.linspace(0, session_bytes - 1, 12).astype(int).tolist():
        memory = copy.deepcopy(before)
        memory.cut_after_bytes = cut_after_bytes
        with pytest.raises(PowerCut):
            flash_over(memory, NEW_IMAGE)
        memory.cut_after_bytes = None
        Controller(flash=memory)  # a trial under way is over with this start
        images = session(MemoryLink(Controller(flash=memory))).description.images
        (running,) = [image for image in images if image.state in (SlotState.TESTING, SlotState.CONFIRMED)]
        assert running.sha256 == sha256(OLD_IMAGE) or (running.name == "new" and running.state == SlotState.CONFIRMED)
        flash_over(memory, NEW_IMAGE)
