"""A controller in memory and in simulated time, just good enough to test the host against, with faults on request."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vibrocast.device_protocol.coded_stream import packet_sequence
from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    ActuatorDescription,
    CaptureData,
    CaptureRead,
    CodecDescription,
    Configure,
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
    ImageDescription,
    Limits,
    Message,
    PacketMessage,
    Pause,
    Resume,
    SlotState,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    Tap,
    pack,
    unpack,
)
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.host.controller import Controller

PACKET_SAMPLES = 10
RATE_HZ = 1000
WATCHDOG_MS = 400


class ScriptedController(Closing):
    """A Transport with the controller at its other end; one channel, PACKET_SAMPLES a packet, RATE_HZ.

    `swallow`, `answer`: hooks that may drop or replace what comes in and goes out. `unplugged` breaks the transport.
    The decoded capture at position p is p, the DAC's is -p.
    """

    def __init__(self) -> None:
        self.now_s = 0.0
        self.description = HelloResponse(
            build="scripted",
            hardware="none",
            limits=Limits(512, 64, 200, 1000, 1, 100, 48_000, WATCHDOG_MS, packet_samples=200),
            actuator=ActuatorDescription("none", 80, 150, 0, 270, 0, 16, RATE_HZ),
            codecs=(CodecDescription(1, "mdct"),),
            images=(ImageDescription(0, SlotState.CONFIRMED), ImageDescription(1, SlotState.EMPTY)),
        )
        self.swallow: Callable[[Message], bool] = lambda message: False
        self.answer: Callable[[Message], Message | None] = lambda message: None
        self.at_read: Callable[[], None] = lambda: None
        self.unplugged = False
        self.largest_read_s = 0.02
        self.check_credit = True
        self.handled: list[Message] = []
        self.flash = bytearray()
        self.begun = FlashBegin(1, 0, bytes(32), "")
        self.outgoing = b""
        self.reopened = 0
        self.restart()

    def restart(self) -> None:
        """Lose everything but the flash."""
        self.reader = FrameReader()
        self.last: tuple[int, bytes] | None = None
        self.configure: Configure | None = None
        self.state = State.IDLE
        self.position = 0
        self.received: set[int] = set()
        self.missing: set[int] = set()
        self.heard_s = self.moved_s = self.now_s

    # ---- Transport ----

    def write(self, data: bytes) -> None:
        self.check()
        self.advance()
        for payload in self.reader.feed(data):
            sequence, message = unpack(payload)
            if self.swallow(message):
                continue
            self.heard_s = self.now_s
            if isinstance(message, PacketMessage):
                self.take(message)
            elif self.last is not None and sequence == self.last[0]:
                self.outgoing += self.last[1]
            else:
                self.handled.append(message)
                answer = self.answer(message) or self.respond(message)
                self.last = (sequence, write_frame(pack(answer, sequence)))
                self.outgoing += self.last[1]
                if isinstance(message, FlashActivate) and not isinstance(answer, Error):
                    self.set_slot(1, SlotState.TESTING)
                    self.restart()

    def read(self, timeout_s: float) -> bytes:
        self.at_read()
        self.check()
        if not self.outgoing:
            self.now_s += min(max(timeout_s, 0.001), self.largest_read_s)
        self.advance()
        data, self.outgoing = self.outgoing, b""
        return data

    def reopen(self) -> None:
        self.outgoing = b""
        self.check()
        self.reopened += 1

    def close(self) -> None:
        pass

    def connect(self) -> Controller:
        """Return a host's session in simulated time."""
        return Controller(self, self.clock, self.sleep)

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.at_read()

    def check(self) -> None:
        if self.unplugged:
            raise TransportError("unplugged")

    # ---- controller ----

    def end(self) -> float:
        assert self.configure is not None
        loops = self.configure.loops
        return loops * self.configure.packets * PACKET_SAMPLES if loops else float("inf")

    def advance(self) -> None:
        watched = self.state in (State.ARMED, State.PLAYING, State.PAUSED)
        until_s = min(self.now_s, self.heard_s + WATCHDOG_MS / 1000) if watched else self.now_s
        elapsed = round((until_s - self.moved_s) * RATE_HZ)
        self.moved_s += elapsed / RATE_HZ
        if self.state == State.ARMED and self.configure is not None:
            if len(self.received) * PACKET_SAMPLES >= min(self.configure.prebuffer_samples, self.end() - self.position):
                self.state = State.PLAYING
        elif self.state == State.PLAYING:
            for _ in range(elapsed):
                if self.position // PACKET_SAMPLES not in self.received:
                    self.missing.add(self.position // PACKET_SAMPLES)
                self.position += 1
                if self.position >= self.end():
                    self.state = State.FINISHED
                    return
        if watched and until_s < self.now_s:
            self.state = State.WATCHDOG

    def take(self, data: PacketMessage) -> None:
        if self.configure is None or data.stream != self.configure.stream:
            return
        for packet in data.packets:
            number = data.iteration * self.configure.packets + packet_sequence(packet)[0]
            if self.check_credit:
                assert (number + 1) * PACKET_SAMPLES <= self.status().credit_until, "more than the credit was sent"
            self.received.add(number)

    def status(self) -> Status:
        buffered = sum(number * PACKET_SAMPLES >= self.position for number in self.received) * PACKET_SAMPLES
        credit = self.position // PACKET_SAMPLES * PACKET_SAMPLES + self.description.limits.buffer_samples
        stream = self.configure.stream if self.configure is not None else 0
        time_us, missing = round(self.now_s * 1e6), len(self.missing)
        return Status(self.state, stream, time_us, self.position, credit, buffered, 0, missing, missing, 0, 0, 0, 0)

    def set_slot(self, slot: int, state: SlotState) -> None:
        described = ImageDescription(slot, state, self.begun.sha256)
        if state in (SlotState.VERIFIED, SlotState.TESTING, SlotState.CONFIRMED):
            image = ModelImage.unpack(bytes(self.flash))
            described = replace(described, name=image.name, version=image.version, number=image.number)
        others = [image for image in self.description.images if image.slot != slot]
        self.description = replace(self.description, images=(*others, described))

    def respond(self, message: Message) -> Message:
        if isinstance(message, Hello):
            return self.description
        if self.last is None:
            return Error(ErrorCode.HELLO_FIRST, "say hello first")
        if isinstance(message, Configure):
            self.configure, self.state = message, State.BUFFERING
            self.position = message.first_packet * PACKET_SAMPLES
            self.received, self.missing = set(), set()
        elif isinstance(message, Start):
            self.state = State.ARMED
        elif isinstance(message, Pause):
            self.state = State.PAUSED
        elif isinstance(message, Resume):
            self.state = State.PLAYING
        elif isinstance(message, Stop):
            self.state = State.STOPPED
        elif isinstance(message, CaptureRead) and self.configure is not None:
            captured = np.arange(self.configure.first_packet * PACKET_SAMPLES, self.position, dtype="<i2")
            offset = max(message.offset, len(captured) - self.description.limits.capture_samples)
            samples = captured[offset : offset + message.count] * (1 if message.tap == Tap.DECODED else -1)
            return CaptureData(message.tap, 1, offset, len(captured), samples.astype("<i2").tobytes())
        elif not isinstance(message, (StatusRequest, Gain)):
            return self.respond_to_flashing(message)
        return self.status()

    def respond_to_flashing(self, message: Message) -> Message:
        if isinstance(message, FlashBegin):
            if message != self.begun:
                self.begun, self.flash = message, bytearray()
            self.set_slot(1, SlotState.WRITING)
            return FlashStatus(1, SlotState.WRITING, len(self.flash))
        if isinstance(message, FlashData):
            if message.offset == len(self.flash):
                self.flash += message.data
            return FlashStatus(1, SlotState.WRITING, len(self.flash))
        if isinstance(message, FlashVerify):
            if sha256(bytes(self.flash)) != self.begun.sha256:
                return Error(ErrorCode.IMAGE_REJECTED, "the hash is wrong")
            self.set_slot(1, SlotState.VERIFIED)
            return FlashStatus(1, SlotState.VERIFIED, len(self.flash), self.begun.sha256)
        if isinstance(message, FlashActivate):
            return FlashStatus(1, SlotState.VERIFIED, len(self.flash))
        if isinstance(message, FlashConfirm):
            self.set_slot(1, SlotState.CONFIRMED)
            return FlashStatus(1, SlotState.CONFIRMED, len(self.flash))
        return Error(ErrorCode.UNKNOWN_MESSAGE, "what is that?")
