"""The simulated controller and the firmware: the same bytes at the same times make the same messages and DAC codes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.device_protocol.test_messages import MESSAGES
from tests.simulated_device.bench import SMALL, stream
from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    REQUESTS,
    CaptureRead,
    Configure,
    EndStream,
    Error,
    Gain,
    Hello,
    HelloResponse,
    Loop,
    Message,
    Pause,
    Resume,
    Start,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
    pack,
    unpack,
)
from vibrocast.output.actuator import (
    LRA,
    PIEZO_STACK,
    Actuator,
    Codes,
)
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.firmware import Firmware
from vibrocast.simulated_device.flash import FlashMemory

STEP_US = 5000
PLAYED = stream(0.5, 2)
LIVE = replace(PLAYED.header, samples=None)
PACKETS = len(PLAYED.packets)

numbers = st.lists(st.integers(0, PACKETS - 1), max_size=PACKETS)
plain = st.sampled_from([StatusRequest(), Start(), Start(50_000), Pause(), Resume(), Stop(), Hello(), Hello(2, 0)])
chosen: st.SearchStrategy[Message] = st.one_of(
    plain,
    st.builds(
        Configure,
        st.just(7),
        st.just(PLAYED.header.pack()),
        st.integers(0, 2000),
        st.just(PACKETS),
        st.sampled_from([0, 0, 10]),
        st.integers(0, 3),
        st.booleans(),
        st.sampled_from([1.0, 0.0, 0.3, 1000.0]),
    ),
    st.builds(Configure, st.just(7), st.just(LIVE.pack()), st.integers(0, 500)),
    st.builds(
        lambda kept, iteration: StreamData(7, iteration, tuple(PLAYED.packets[number] for number in kept)),
        st.one_of(st.just(list(range(PACKETS))), numbers),
        st.integers(0, 2),
    ),
    st.builds(Loop, st.integers(0, 3)),
    st.builds(Gain, st.sampled_from([0.0, 0.5, 3.0])),
    st.builds(EndStream, st.just(7), st.integers(0, PACKETS)),
    st.builds(CaptureRead, st.sampled_from(Tap), st.integers(0, 1500), st.integers(0, 100)),
)
any_request = st.sampled_from([*REQUESTS, StreamData]).flatmap(lambda message_type: MESSAGES[message_type])
# What plays, most of the time; any message; bytes of the wire; milliseconds that pass.
steps = st.lists(
    st.one_of(chosen, chosen, chosen, any_request, st.binary(max_size=20), st.integers(0, 400)), min_size=1, max_size=30
)
beginning: list[Message | bytes | int] = [
    Hello(),
    Configure(7, PLAYED.header.pack(), 200, PACKETS),
    StreamData(7, 0, PLAYED.packets),
    Start(),
    100,
]


class Recorder:
    """A controller, and all that it has sent and put out."""

    def __init__(self, kind: type[Controller] | type[Firmware], actuator: Actuator) -> None:
        self._codes: list[Codes] = []
        small = replace(SMALL, actuator=actuator, watchdog_ms=1000)
        self._controller = kind(small, FlashMemory(6 * 4096), self._codes.append)
        self._reader = FrameReader()
        self._now_us = 0
        self._sequence = 0

    def take(self, step: Message | bytes | int) -> tuple[list[tuple[int, Message]], list[list[int]]]:
        """Take a step; return what was sent and put out. Texts are each controller's own."""
        if isinstance(step, int):
            for _ in range(0, step * 1000, STEP_US):
                self._now_us += STEP_US
                self._controller.advance(self._now_us)
        elif isinstance(step, bytes):
            self._controller.receive(step + b"\0", self._now_us)
        else:
            self._sequence += 1
            self._controller.receive(write_frame(pack(step, self._sequence)), self._now_us)
        sent = [unpack(payload) for payload in self._reader.feed(self._controller.transmit())]
        codes = np.concatenate(self._codes).tolist() if self._codes else []
        self._codes.clear()
        return [(sequence, without_texts(message)) for sequence, message in sent], codes


def without_texts(message: Message) -> Message:
    """Return a message without texts for a person, and without the list of codecs: the simulated one has more."""
    if isinstance(message, Error):
        return replace(message, text="")
    return replace(message, build="", codecs=()) if isinstance(message, HelloResponse) else message


@pytest.mark.slow
@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.sampled_from([PIEZO_STACK, LRA]), st.booleans(), steps)
def test_any_bytes_at_any_time_are_answered_and_played_alike(
    actuator: Actuator, plays: bool, drawn: list[Message | bytes | int]
) -> None:
    simulated, firmware = Recorder(Controller, actuator), Recorder(Firmware, actuator)
    for step in [*(beginning if plays else beginning[:1]), *drawn, 500, Stop(), 500]:
        assert firmware.take(step) == simulated.take(step)
