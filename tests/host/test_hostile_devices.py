"""Tests that every wait for a controller ends with an error in words, whatever the controller answers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.host.scripted_controller import RATE_HZ, ScriptedController
from tests.host.test_player import PACKETS, SECONDS, Coded
from vibrocast import codec, textures
from vibrocast.codec.encoding import encode_profile
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import (
    CaptureData,
    CaptureRead,
    CodecDescription,
    Configure,
    EndStream,
    FlashBegin,
    FlashData,
    FlashStatus,
    ImageDescription,
    Message,
    Position,
    SlotState,
    Start,
    State,
    Status,
    StatusRequest,
    Tap,
)
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import hand_playback, live
from vibrocast.host.controller import ControllerError
from vibrocast.host.player import PlaybackSettings, play
from vibrocast.host.stream_session import READ_BACK_S, read_capture
from vibrocast.host.uploader import flash

Lie = Callable[[ScriptedController, float], Status]

MARGIN_S = 65.0
"""What a playback may take besides its duration and a fifth of it."""


def answering(lie: Lie) -> ScriptedController:
    """Return a controller that answers so, from the Start on, by the time since then."""
    scripted = ScriptedController()
    scripted.check_credit = False
    began_s: list[float] = []

    def answer(message: Message) -> Message | None:
        if isinstance(message, Start):
            began_s.append(scripted.now_s)
        if not began_s or not isinstance(message, (Start, StatusRequest)):
            return None
        return lie(scripted, scripted.now_s - began_s[0])

    scripted.answer = answer
    return scripted


LIES: dict[str, Lie] = {
    "pauses for ever": lambda device, _: replace(device.status(), state=State.PAUSED, position=500),
    "waits for ever": lambda device, _: replace(device.status(), state=State.ARMED, position=0),
    "buffers for ever": lambda device, _: replace(device.status(), state=State.BUFFERING, position=0),
    "stands at the end": lambda device, _: replace(device.status(), state=State.PLAYING, position=len(PACKETS) * 10),
    "creeps": lambda device, s: replace(device.status(), state=State.PLAYING, position=int(s * 20)),
    "creeps in pause": lambda device, s: replace(device.status(), state=State.PAUSED, position=int(s * 20)),
    "goes back": lambda device, s: replace(device.status(), state=State.PLAYING, position=1000 - int(s * 10) % 1000),
}


@pytest.mark.parametrize("name", LIES)
@pytest.mark.parametrize("loops", [1, 0])
def test_playing_ends(name: str, loops: int) -> None:
    scripted = answering(LIES[name])
    with pytest.raises(ControllerError, match=r"has played only .* s of the stream in .* s; restart it"):
        play(scripted.connect(), Coded(PACKETS), PlaybackSettings(loops=loops))
    assert scripted.now_s < 1.2 * SECONDS + 10


def test_a_controller_that_is_slow_within_its_tolerance_plays_on() -> None:
    slow = answering(
        lambda device, s: replace(
            device.status(),
            state=State.PLAYING if s < 100 else State.FINISHED,
            position=int(0.95 * s * RATE_HZ),
            credit_until=1 << 40,
        )
    )
    assert play(slow.connect(), Coded(PACKETS), PlaybackSettings(loops=0)).state == State.FINISHED


def test_a_connection_that_breaks_again_and_again_is_given_up() -> None:
    scripted = ScriptedController()

    def creep(message: Message) -> Message | None:
        if isinstance(message, StatusRequest) and scripted.configure is not None:
            return replace(scripted.status(), state=State.PLAYING, position=scripted.reopened, credit_until=1 << 40)
        return None

    def unplug_soon() -> None:
        scripted.unplugged = int(scripted.now_s) % 3 == 2

    scripted.answer, scripted.at_read, scripted.check_credit = creep, unplug_soon, False
    with pytest.raises((ControllerError, TransportError)) as caught:
        play(scripted.connect(), Coded(PACKETS), PlaybackSettings(loops=10_000))
    assert str(caught.value)
    assert scripted.now_s < MARGIN_S + 20


@settings(max_examples=60)
@given(st.data())
def test_whatever_is_reported_playing_ends(data: st.DataObject) -> None:
    scripted = ScriptedController()
    positions = st.one_of(st.integers(0, 1500), st.integers(0, (1 << 64) - 1))

    def lie(message: Message) -> Message | None:
        if not data.draw(st.booleans()):
            return None
        if isinstance(message, (Configure, Start, StatusRequest)):
            state, position = data.draw(st.sampled_from(State)), data.draw(positions)
            return replace(scripted.status(), state=state, position=position, credit_until=data.draw(positions))
        if isinstance(message, CaptureRead):
            offset = data.draw(st.sampled_from([message.offset, 0, 1 << 60]))
            return CaptureData(message.tap, data.draw(st.integers(1, 2)), offset, 1 << 62, bytes(400))
        return None

    scripted.answer, scripted.check_credit = lie, False
    try:
        capture = data.draw(st.booleans())
        result = play(scripted.connect(), Coded(PACKETS), PlaybackSettings(capture=capture, reconnect_s=1))
        assert result.state in (State.FINISHED, State.STOPPED)
    except (ControllerError, TransportError) as error:
        assert str(error)
    assert scripted.now_s < 1.2 * SECONDS + MARGIN_S


def captured(scripted: ScriptedController, samples: int, message: CaptureRead) -> CaptureData:
    scripted.now_s += 0.01
    return CaptureData(message.tap, 1, message.offset, 1 << 62, bytes(2 * min(samples, message.count)))


@pytest.mark.parametrize(
    ("samples", "reason"), [(1, "sends 1 captured samples in a frame for"), (1000, "takes too long")]
)
def test_reading_a_capture_back_ends(samples: int, reason: str) -> None:
    scripted = ScriptedController()
    controller = scripted.connect()
    scripted.answer = lambda message: captured(scripted, samples, message) if isinstance(message, CaptureRead) else None
    with pytest.raises(ControllerError, match=reason):
        read_capture(controller, Tap.DAC, 1)
    assert scripted.now_s < READ_BACK_S + 5


def test_an_upload_ends_though_each_cut_gains_a_byte() -> None:
    image = ModelImage(1, "oak", "1", "", bytes(100_000)).pack()
    scripted = ScriptedController()

    def gain(message: Message) -> Message | None:
        if isinstance(message, FlashBegin):
            return FlashStatus(1, SlotState.WRITING, scripted.reopened)
        if isinstance(message, FlashData):
            scripted.unplugged = True
        return None

    def plug() -> None:
        scripted.unplugged = False

    scripted.answer, scripted.sleep = gain, lambda seconds: plug()  # type: ignore[method-assign]
    with pytest.raises((ControllerError, TransportError)) as caught:
        flash(scripted.connect(), image)
    assert str(caught.value)
    assert scripted.reopened < 40


def test_a_hello_of_endless_slots_is_read_at_once() -> None:
    scripted = ScriptedController()
    slots = tuple(ImageDescription(number % 256, SlotState.EMPTY) for number in range(80))
    codecs = tuple(CodecDescription(number % 256, "c") for number in range(80))
    scripted.description = replace(scripted.description, images=slots, codecs=codecs)
    assert scripted.connect().description.images == slots


@pytest.fixture(scope="module")
def profile() -> Stream:
    coded = encode_profile(textures.Profile(np.sin(np.arange(400) / 9), 50.0, "waves").recording(10.0), 10.0)
    return coded.stream


@pytest.mark.parametrize("rate", [0.0, -1.0, 0.01])
def test_a_hand_whose_controller_keeps_no_time_ends(rate: float, profile: Stream) -> None:
    scripted = ScriptedController()
    limits = replace(scripted.description.limits, profile_samples=1 << 20, max_payload_bytes=4096)
    scripted.description = replace(scripted.description, limits=limits)
    samples = len(profile.packets) * profile.packet_samples

    def slow(message: Message) -> Message | None:
        if not isinstance(message, (Start, StatusRequest)):
            return None
        time_us = int(1e8 + 1e6 * rate * scripted.now_s)
        return replace(scripted.status(), state=State.PLAYING, position=samples, device_time_us=time_us)

    scripted.answer, scripted.swallow = slow, lambda message: isinstance(message, Position)
    movement = hand_playback.back_and_forth(10.0, 50.0, 2)
    with pytest.raises(ControllerError, match="clock is too slow, or stands still"):
        hand_playback.play(scripted.connect(), profile, movement)
    assert scripted.now_s < 1.2 * movement.seconds + 10


def test_loading_a_profile_ends_though_the_controller_creeps(profile: Stream) -> None:
    scripted = ScriptedController()
    limits = replace(scripted.description.limits, profile_samples=1 << 20, max_payload_bytes=4096)
    scripted.description = replace(scripted.description, limits=limits)

    def creep(message: Message) -> Message | None:
        scripted.now_s += 1.0
        if not isinstance(message, StatusRequest):
            return None
        return replace(scripted.status(), position=int(scripted.now_s / 4.9) * profile.packet_samples, credit_until=0)

    scripted.answer = creep
    with pytest.raises(ControllerError, match="does not get through"):
        hand_playback.load(scripted.connect(), profile)
    assert scripted.now_s < 60


def test_a_live_stream_bears_a_clock_that_jumps() -> None:
    scripted = answering(lambda device, _: replace(device.status(), device_time_us=2**63))
    stream = live.LiveStream(scripted.connect(), codec.SignalFormat(RATE_HZ, "um", (1.0,), (0.1,)))
    stream._link.bytes_per_second = 1000.0  # as after a slow packet
    stream._link.hear(replace(scripted.status(), device_time_us=2**63), 16, scripted.now_s)
    assert stream.link_bytes_per_second > 1000


def test_the_end_of_a_live_stream_is_not_awaited_for_ever() -> None:
    scripted = ScriptedController()
    scripted.check_credit = False

    def never(message: Message) -> Message | None:
        if isinstance(message, (Start, StatusRequest, EndStream)) and scripted.configure is not None:
            return replace(scripted.status(), state=State.PLAYING, position=0)
        return None

    scripted.answer = never
    controller = scripted.connect()
    stream = live.LiveStream(controller, codec.SignalFormat(RATE_HZ, "um", (1.0,), (0.1,)))
    stream.send(np.zeros((60_000, 1)))
    ended_s = scripted.now_s
    with pytest.raises(ControllerError, match="end has not been played"):
        stream.finish()
    assert scripted.now_s - ended_s < 40
