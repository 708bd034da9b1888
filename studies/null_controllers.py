"""Controllers that decode nothing, on pseudo-terminals: they load a host as real ones do, and the machine far less.

`python -m studies.null_controllers COUNT` prints the name of each port on a line, and serves them until its input ends.
"""

import math
import os
import selectors
import sys
import time
import tty
from dataclasses import dataclass, field

import click

from vibrocast.codec import codec_by_identifier, decoder
from vibrocast.device_protocol.coded_stream import MAX_CHANNELS, StreamHeader, packet_sequence
from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    NOTIFICATION,
    ActuatorDescription,
    CodecDescription,
    Configure,
    Error,
    ErrorCode,
    Hello,
    HelloResponse,
    Limits,
    Message,
    PacketMessage,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    pack,
    unpack,
)

BUFFER_SAMPLES = 32768
HELLO = HelloResponse(
    build="null",
    hardware="null",
    limits=Limits(4096, 4084, BUFFER_SAMPLES, 0, MAX_CHANNELS, 100, 48_000, 2000, packet_samples=BUFFER_SAMPLES),
    actuator=ActuatorDescription("none", 80.0, 150.0, 0.0, 270.0, 0.0, 16, 8000),
    codecs=(CodecDescription(1, "mdct"),),
)
STATUS_INTERVAL_S = 0.1
TURN_S = 0.01
# A busy computer keeps the process waiting, unlike a controller. Of a longer wait, the clock counts only this much.
MAX_STEP_S = 0.05


@dataclass
class NullController:
    """One of them: it counts packets, lets them pass by its clock, and tells so. `port`: its end of the terminal."""

    port: int
    reader: FrameReader = field(default_factory=FrameReader)
    configure: Configure | None = None
    rate_hz: int = 1
    packet_samples: int = 1
    packets: float = math.inf
    state: State = State.IDLE
    began_s: float = 0.0
    told_s: float = 0.0
    received: int = 0
    underruns: int = 0
    lost_packets: int = 0
    last: tuple[int, bytes] = (NOTIFICATION, b"")

    def receive(self, data: bytes, now_s: float) -> None:
        """Take in bytes, and answer."""
        for payload in self.reader.feed(data):
            sequence, message = unpack(payload)
            if isinstance(message, PacketMessage):
                self._take(message, now_s)
            elif sequence == self.last[0]:
                os.write(self.port, self.last[1])
            else:
                answer = self._answer(message, now_s)
                self.last = sequence, write_frame(pack(answer, sequence))
                os.write(self.port, self.last[1])

    def turn(self, now_s: float) -> None:
        """Let time pass; tell the status when the state changes, and often enough."""
        state = self.state
        if state == State.ARMED and self.configure is not None:
            if self.received < min(self.packets, self.configure.prebuffer_samples // self.packet_samples):
                self.began_s = max(self.began_s, now_s)
            elif now_s >= self.began_s:
                self.state = State.PLAYING
        elif state == State.PLAYING:
            behind = self._position(now_s) // self.packet_samples - self.received
            if self.received >= self.packets and behind >= 0:
                self.state = State.FINISHED
            elif behind > 0:
                self.underruns += 1
                self.lost_packets += behind
                self.received += behind
        if state != self.state or (state == State.PLAYING and now_s >= self.told_s + STATUS_INTERVAL_S):
            self.told_s = now_s
            os.write(self.port, write_frame(pack(self._status(now_s))))

    def _take(self, data: PacketMessage, now_s: float) -> None:
        if self.configure is not None and data.stream == self.configure.stream:
            for packet in data.packets:
                number, _ = packet_sequence(packet)
                self.lost_packets += max(0, number - self.received)
                self.received = max(self.received, number + 1)

    def _position(self, now_s: float) -> int:
        if self.state == State.PLAYING:
            return int(min((now_s - self.began_s) * self.rate_hz, self.packets * self.packet_samples))
        return self.received * self.packet_samples if self.state == State.FINISHED else 0

    def _answer(self, message: Message, now_s: float) -> Message:
        if isinstance(message, Hello):
            return HELLO
        if isinstance(message, Configure):
            header, _ = StreamHeader.unpack(message.header)
            codec = codec_by_identifier(header.codec_identifier, header.configuration)
            of_stream = decoder(codec.identifier, header.configuration, header.channels)
            self.configure, self.rate_hz, self.packet_samples = message, header.rate_hz, of_stream.packet_samples
            self.packets = message.packets or math.inf  # a live stream has no end
            self.state, self.received, self.underruns, self.lost_packets = State.BUFFERING, 0, 0, 0
        elif isinstance(message, Start):
            self.state, self.began_s = State.ARMED, max(now_s, message.device_time_us / 1e6)
        elif isinstance(message, Stop):
            self.state = State.STOPPED
        elif not isinstance(message, StatusRequest):
            return Error(ErrorCode.UNKNOWN_MESSAGE, "this controller only plays")
        return self._status(now_s)

    def _status(self, now_s: float) -> Status:
        position, stream = self._position(now_s), self.configure.stream if self.configure else 0
        held_samples = max(0, self.received * self.packet_samples - position)
        credit = (position + BUFFER_SAMPLES) // self.packet_samples * self.packet_samples
        counts = (self.reader.bad_frames, self.underruns, self.lost_packets, 0, 0, 0, 0)
        return Status(self.state, stream, round(1e6 * now_s), position, credit, held_samples, *counts)


def serve(count: int) -> None:
    """Serve a number of controllers until standard input ends."""
    with selectors.DefaultSelector() as selector:
        controllers = []
        for _ in range(count):
            port, other = os.openpty()  # the other end stays open, so that the port outlives its host
            tty.setraw(other)
            controllers.append(NullController(port))
            selector.register(port, selectors.EVENT_READ, controllers[-1])
            print(os.ttyname(other), flush=True)
        selector.register(sys.stdin, selectors.EVENT_READ)
        now_s = turn_s = 0.0
        read_s = time.monotonic()
        while True:
            ready = selector.select(max(0.0, turn_s - now_s))
            passed_s, read_s = time.monotonic() - read_s, time.monotonic()
            now_s += min(passed_s, MAX_STEP_S)
            for key, _ in ready:
                if key.data is None:
                    return
                key.data.receive(os.read(key.fd, 1 << 16), now_s)
            if now_s >= turn_s:
                turn_s = now_s + TURN_S
                for controller in controllers:
                    controller.turn(now_s)


@click.command()
@click.argument("count", type=click.IntRange(min=1))
def main(count: int) -> None:
    """Print the ports of COUNT controllers, and serve them until standard input ends."""
    serve(count)


if __name__ == "__main__":
    main()
