"""A bench for tests: a coded stream, and a controller that is spoken to message by message in simulated time."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from vibrocast import codec
from vibrocast.codec import Decoded
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    CaptureData,
    CaptureRead,
    Configure,
    Hello,
    Message,
    Start,
    Status,
    StatusRequest,
    StreamData,
    Tap,
    pack,
    unpack,
)
from vibrocast.output.actuator import Codes
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.flash import FlashMemory

RATE_HZ = 2800

SMALL = Settings(channels=2, buffer_samples=4096, capture_samples=1000, profile_samples=4096)
"""The limits of a small board."""


@dataclass(frozen=True)
class Stream:
    """A coded stream and what it decodes to, every packet: int16 (samples, channels)."""

    header: StreamHeader
    packets: tuple[bytes, ...]
    decoded: Decoded
    packet_samples: int
    delay_samples: int


@cache
def stream(seconds: float = 1.0, channels: int = 1, unit: str = "um") -> Stream:
    """Return a coded texture of moderate strength, with a refresh every quarter of a second."""
    samples = round(seconds * RATE_HZ)
    time_s = np.arange(samples)[:, None] / RATE_HZ
    noise = np.random.default_rng(5).standard_normal((samples, channels))
    signal = 6.0 * np.sin(2 * np.pi * 150 * time_s + np.arange(channels)) + 2.0 * noise
    coded = codec.encode(signal, RATE_HZ, {"step": 0.4}, live=True)
    header = StreamHeader(1, RATE_HZ, samples, unit, coded.header.gains, coded.header.configuration)
    decoder = codec.decoder(1, coded.header.configuration, channels)
    return Stream(header, coded.packets, coded.decode_integers(), decoder.packet_samples, decoder.delay_samples)


@dataclass
class Bench:
    """A controller under test. `codes`: all that went to its DAC. `firmware`: as of Controller."""

    settings: Settings = field(default_factory=Settings)
    flash: FlashMemory | None = None
    now_us: int = 0
    sequence: int = 0
    codes: list[Codes] = field(default_factory=list)
    notified: list[Message] = field(default_factory=list)
    firmware: tuple[Any, Any] | None = None

    def __post_init__(self) -> None:
        self.controller = Controller(self.settings, self.flash, self.codes.append, self.firmware)
        self._reader = FrameReader()

    def ask(self, message: Message) -> Message:
        """Send a request and return the answer, which must come at once."""
        self.sequence += 1
        return self.ask_as(self.sequence, message)

    def ask_as(self, sequence: int, message: Message) -> Message:
        """Send a request under a given sequence number and return its one answer."""
        answers = self.send_payload(pack(message, sequence))
        assert [number for number, _ in answers] == [sequence]
        return answers[0][1]

    def send_payload(self, payload: bytes) -> list[tuple[int, Message]]:
        """Send a payload; return the answers, put notifications aside."""
        self.controller.receive(write_frame(payload), self.now_us)
        return self.collect()

    def collect(self) -> list[tuple[int, Message]]:
        """Return the answers that the controller has sent, put notifications aside."""
        messages = [unpack(payload) for payload in self._reader.feed(self.controller.transmit())]
        self.notified += [message for sequence, message in messages if sequence == 0]
        return [(sequence, message) for sequence, message in messages if sequence]

    def run(self, milliseconds: int, polling: bool = True) -> None:
        """Let time pass; while `polling`, ask for the status often enough for the watchdog."""
        for millisecond in range(milliseconds):
            self.now_us += 1000
            self.controller.advance(self.now_us)
            if polling and millisecond % 100 == 99:
                self.status()

    def status(self) -> Status:
        answer = self.ask(StatusRequest())
        assert isinstance(answer, Status)
        return answer

    def configure(self, played: Stream, **options: int | float | bool) -> Message:
        """Say hello and configure a stream as number 7."""
        self.ask(Hello())
        arguments = {"prebuffer_samples": 280, "packets": len(played.packets), **options}
        return self.ask(Configure(7, played.header.pack(), **arguments))  # type: ignore[arg-type]

    def send(self, played: Stream, numbers: range, iteration: int = 0) -> None:
        """Send packets of the stream."""
        for number in numbers:
            self.send_payload(pack(StreamData(7, iteration, (played.packets[number],))))

    def start_all(self, played: Stream, **options: int | float | bool) -> None:
        """Configure a stream, send all of it and start it."""
        assert isinstance(self.configure(played, **options), Status)
        self.send(played, range(len(played.packets)))
        assert isinstance(self.ask(Start()), Status)

    def captured(self, tap: Tap) -> Codes:
        """Read a whole capture back: int16 (n, channels)."""
        pieces: list[Codes] = []
        offset = 0
        while True:
            answer = self.ask(CaptureRead(tap, offset, 60_000))
            assert isinstance(answer, CaptureData)
            assert answer.offset == offset
            samples = np.frombuffer(answer.data, "<i2").astype(np.int16).reshape(-1, answer.channels)
            pieces.append(samples)
            offset += len(samples)
            if offset == answer.end:
                return np.concatenate(pieces)

    def all_codes(self) -> Codes:
        """All codes that went to the DAC."""
        return np.concatenate(self.codes) if self.codes else np.zeros((0, 1), np.int16)


class Echo(Device):
    """Sends back all that it receives, and keeps it with its time."""

    def __init__(self) -> None:
        self.received: list[tuple[int, bytes]] = []
        self._waiting = b""

    def receive(self, data: bytes, now_us: int) -> None:
        self.received.append((now_us, data))
        self._waiting += data

    def advance(self, now_us: int) -> None:
        """Do nothing."""

    def transmit(self) -> bytes:
        data, self._waiting = self._waiting, b""
        return data
