"""Speaks to a controller message by message and, where it answers otherwise than it must, says what was expected."""

import math
import random
from collections import deque
from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.coded_stream import packet_sequence
from vibrocast.device_protocol.frames import DELIMITER, FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    MAX_SEQUENCE,
    NOTIFICATION,
    CaptureData,
    CaptureRead,
    Configure,
    Error,
    ErrorCode,
    FlashBegin,
    FlashVerify,
    Hello,
    HelloResponse,
    Message,
    MessageError,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
    pack,
    unpack,
)
from vibrocast.device_protocol.transports import TransportError
from vibrocast.harness.conformance.tapped_link import TappedLink
from vibrocast.host.controller import MIN_PAYLOAD_LIMIT_BYTES
from vibrocast.host.stream_session import next_number

# docs/reference/protocol.md, "Sequence numbers" and "FlashActivate": the longest answers, and the longest restart.
ANSWER_S = 2.0
SLOT_S = 10.0
RESTART_S = 10.0

_READ_S = 0.05
_MIN_READ_S = 0.001  # simulated time may not be able to pass for less
_POLL_S = 0.01
_RETRY_S = 0.1
# Slower than that, a host sends copies of its requests, and each may be answered.
_COPIED_S = 0.1
# How long the first Hello waits, which a restart may have swallowed; each one after it waits for twice as long.
_FIRST_ANSWER_S = 0.5

_Answer = TypeVar("_Answer", bound=Message)


class NotConforming(AssertionError):
    """The controller did not do what the protocol says; the text states both."""


class Undecided(Exception):
    """This machine, or an emulator on it, was too slow for a verdict."""


class Unreachable(Exception):
    """The controller cannot be reached, or no longer answers."""


class Probe:
    """A session with a controller in which each request goes out once, and nothing that comes back is overlooked.

    `description`: the last answer to Hello, and `opened_by` its number. `sequence`: the number of the last request.
    `last_answer`: the payload that answered it. `answer_s`: the longest that an answer took, of a slot's aside.
    `notified`: the notifications that came, oldest first.
    """

    description: HelloResponse

    def __init__(self, link: TappedLink) -> None:
        self.link = link
        self.opened_by = self.sequence = NOTIFICATION
        self.last_answer = b""
        self.answer_s = 0.0
        self.notified: list[Message] = []
        self._reader = FrameReader()
        self._inbox: deque[bytes] = deque()
        self._limit_bytes = 0  # of a payload; 0: not known yet
        self._sent_s, self._max_silence_s = 0.0, math.inf

    def open(self, within_s: float = RESTART_S) -> None:
        """Open a session, or open it again. Raises Unreachable, NotConforming."""
        answer = self.insist(Hello(), within_s)
        if not isinstance(answer, HelloResponse):
            raise NotConforming(f"Hello: expected a HelloResponse, came {describe(answer)}")
        self.description = answer
        self.opened_by = self.sequence
        # A limit below the protocol's is a fault of its own, and must not hide another.
        self._limit_bytes = max(answer.limits.max_payload_bytes, MIN_PAYLOAD_LIMIT_BYTES)
        self._max_silence_s = max(_POLL_S, answer.limits.watchdog_ms / 4000)
        if self.answer_s > _COPIED_S:
            self._overlook(ANSWER_S)  # answers to copies of requests of a session before
        self.notified.clear()

    def insist(self, message: Message, within_s: float = RESTART_S) -> Message:
        """Ask until an answer comes, and overlook all else: also while the controller, or its port, starts again.

        Raises Unreachable after `within_s`.
        """
        deadline_s = self.link.clock() + within_s
        patience_s = _FIRST_ANSWER_S
        while True:
            reason = f"nothing answers {name(message)}"
            try:
                self.link.write(DELIMITER)  # ends whatever the link has picked up
                # A number that means nothing to the controller yet.
                self.sequence = random.randint(1, MAX_SEQUENCE)
                self.send(pack(message, self.sequence))
                requested_s = self.link.clock()
                answer_until_s = requested_s + patience_s
                patience_s = min(2 * patience_s, ANSWER_S)
                while (payload := self._next(answer_until_s)) is not None:
                    try:
                        sequence, answer = unpack(payload)
                    except MessageError as error:
                        reason = f"what comes after {name(message)} cannot be read ({error})"
                        continue
                    if sequence == self.sequence:
                        self.last_answer = payload
                        self.answer_s = max(self.answer_s, self.link.clock() - requested_s)
                        return answer
            except TransportError as error:
                reason = str(error)
                try:
                    self.link.reopen()
                except TransportError as failure:
                    reason = str(failure)
                self._reader = FrameReader()
            if self.link.clock() >= deadline_s:
                raise Unreachable(reason)
            self.link.sleep(_RETRY_S)

    def send(self, payload: bytes) -> None:
        """Send a payload in a frame. Raises TransportError."""
        self.link.write(write_frame(payload))
        self._sent_s = self.link.clock()

    def ask(self, message: Message) -> Message:
        """Send a request under the next number and return its answer. Raises NotConforming, TransportError."""
        within_s = SLOT_S if isinstance(message, (FlashBegin, FlashVerify)) else ANSWER_S
        return self.ask_body(message.TYPE, message.body(), within_s=within_s)

    def ask_body(
        self, message_type: int, body: bytes, sequence: int | None = None, within_s: float = ANSWER_S
    ) -> Message:
        """Send a body that may be no message's at all; return what answers its number, None = the next one.

        Raises NotConforming, TransportError.
        """
        if sequence is None:
            sequence = self.sequence % MAX_SEQUENCE + 1
        self.send(bytes([message_type]) + sequence.to_bytes(2, "little") + body)
        return self.answer(sequence, within_s)

    def answer(self, sequence: int, within_s: float = ANSWER_S) -> Message:
        """Wait for the answer to this number and return it. Raises NotConforming, TransportError."""
        self.sequence = sequence
        bad_frames = self._reader.bad_frames
        requested_s = self.link.clock()
        while (payload := self._next_while_alive(requested_s + within_s)) is not None:
            answered, message = self._read(payload)
            if answered == sequence:
                self.last_answer = payload
                if within_s == ANSWER_S:
                    self.answer_s = max(self.answer_s, self.link.clock() - requested_s)
                return message
            if answered != NOTIFICATION:
                raise NotConforming(
                    f"expected nothing but an answer to request {sequence}, came one to {answered}: {describe(message)}"
                )
        damaged = self._reader.bad_frames - bad_frames
        came = f"nothing but {damaged} damaged frame(s)" if damaged else "none"
        raise NotConforming(f"expected an answer within {within_s:g} s, came {came}")

    def expect(self, message: Message, answer_type: type[_Answer]) -> _Answer:
        """Send a request that must be carried out; return its answer. Raises NotConforming, TransportError."""
        answer = self.ask(message)
        if not isinstance(answer, answer_type):
            raise NotConforming(f"{name(message)}: expected {answer_type.__name__}, came {describe(answer)}")
        return answer

    def expect_rejection(self, message: Message, code: ErrorCode) -> Error:
        """Send a request that must be rejected with this code; return the Error. Raises as `expect`."""
        return an_error(self.ask(message), code, name(message))

    def unanswered(self, payload: bytes, what: str) -> None:
        """Send a payload that must not be answered, before one that must. Raises NotConforming, TransportError."""
        self.send(payload)
        try:
            self.status()
        except NotConforming as fault:
            raise NotConforming(f"after {what}, which is not to be answered: {fault}") from None

    def listen(self, seconds: float) -> None:
        """Take in notifications for so long, while the watchdog is kept content.

        Raises NotConforming for anything else that comes, TransportError.
        """
        deadline_s = self.link.clock() + seconds
        while (payload := self._next_while_alive(deadline_s)) is not None:
            answered, message = self._read(payload)
            if answered != NOTIFICATION:
                raise NotConforming(f"expected notifications only, came {describe(message)}")

    def complaint(self, payload: bytes, code: ErrorCode, what: str) -> None:
        """Send stream data that must be answered by an Error without a number. Raises NotConforming, TransportError."""
        self.notified.clear()
        self.send(payload)
        self.status()
        errors = [message for message in self.notified if isinstance(message, Error)]
        if [error.code for error in errors] != [code]:
            came = ", ".join(map(describe, errors)) or "none"
            raise NotConforming(f"{what}: expected one Error {code.name} with the number 0, came {came}")

    def status(self) -> Status:
        """Ask for the status. Raises NotConforming, TransportError."""
        return self.expect(StatusRequest(), Status)

    def stop(self) -> Status:
        """Bring the output to rest. Raises NotConforming, TransportError."""
        return in_state(self.expect(Stop(), Status), State.STOPPED, "Stop")

    def wait_for(self, condition: Callable[[Status], bool], what: str, within_s: float) -> Status:
        """Ask for the status until the condition holds, and return it. Raises NotConforming, TransportError."""
        deadline_s = self.link.clock() + within_s
        while not condition(status := self.status()):
            if self.link.clock() > deadline_s:
                raise NotConforming(f"expected {what} within {within_s:g} s; it is still {describe(status)}")
            self.link.sleep(_POLL_S)
        return status

    def wait_for_state(self, state: State, within_s: float = ANSWER_S) -> Status:
        """Ask for the status until the controller is in this state. Raises NotConforming, TransportError."""
        return self.wait_for(lambda status: status.state == state, f"the state {state.name}", within_s)

    def configure(self, stream: Stream, **options: int | float | bool) -> Status:
        """Set up a stream under a number that none had before; all of its packets make the iteration if not said.

        Raises NotConforming, TransportError.
        """
        return in_state(self.expect(self.configuration(stream, **options), Status), State.BUFFERING, "Configure")

    def configuration(self, stream: Stream, **options: int | float | bool) -> Configure:
        """Return what sets up a stream under a number that none had before. Raises NotConforming, TransportError."""
        arguments = {"prebuffer_samples": 0, "packets": len(stream.packets), **options}
        return Configure(next_number(self.status().stream), stream.header.pack(), **arguments)  # type: ignore[arg-type]

    def feed(self, number: int, stream: Stream, packets: Iterable[bytes] | None = None, iteration: int = 0) -> None:
        """Send packets, in their order, of the stream set up under this number, all if not said, as credit allows.

        Skips the test where the controller has no room for them. Raises NotConforming, TransportError.
        """
        packet_samples = stream.packet_samples
        waiting = list(stream.packets if packets is None else packets)
        deadline_s = self.link.clock() + ANSWER_S + 2 * stream.seconds
        while waiting:
            status = self.status()
            granted = status.credit_until // packet_samples - iteration * len(stream.packets)
            fitting = [packet for packet in waiting if packet_sequence(packet)[0] < granted]
            if fitting:
                self.send_packets(number, fitting, iteration)
                del waiting[: len(fitting)]
            elif status.state == State.BUFFERING or self.link.clock() > deadline_s:
                pytest.skip("the controller's buffer does not hold the stream")
            else:
                self.link.sleep(_POLL_S)

    def send_packets(self, number: int, packets: Iterable[bytes], iteration: int = 0) -> None:
        """Send packets without a look at credit, as many in a frame as it holds. Raises TransportError."""
        frame: tuple[bytes, ...] = ()
        for packet in packets:
            longer = (*frame, packet)
            if frame and len(pack(StreamData(number, iteration, longer))) > self._limit_bytes:
                self.send(pack(StreamData(number, iteration, frame)))
                longer = (packet,)
            frame = longer
        self.send(pack(StreamData(number, iteration, frame)))

    def play(self, stream: Stream, **options: int | float | bool) -> Status:
        """Play a stream that the buffer holds, to its end; return the last status. Raises as `expect`."""
        first = int(options.get("first_packet", 0))
        number = self.configure(stream, **options).stream
        self.feed(number, stream, stream.packets[first:])
        self.expect(Start(), Status)
        return self.wait_for_state(State.FINISHED, ANSWER_S + 2 * stream.seconds)

    def captured(self, tap: Tap, channels: int) -> tuple[int, NDArray[np.int16]]:
        """Return what is left of a capture, int16 (samples, channels), and the number of its first sample.

        Raises NotConforming, TransportError.
        """
        pieces = [np.zeros((0, channels), np.int16)]
        begin = self.read_capture(tap, 0, 0xFFFF, channels)
        first = offset = begin.offset
        limit = self.description.limits.capture_samples
        if begin.end - first > limit:
            raise NotConforming(f"expected a capture of at most {limit} samples, came {describe(begin)}")
        while True:
            answer = self.read_capture(tap, offset, 0xFFFF, channels)
            samples = np.frombuffer(answer.data, "<i2").astype(np.int16).reshape(-1, channels)
            pieces.append(samples)
            offset += len(samples)
            if offset >= answer.end:
                return first, np.concatenate(pieces)
            if (answer.offset + len(samples), answer.end) != (offset, begin.end) or not len(samples):
                raise NotConforming(f"CaptureRead of a stream at rest from sample {offset}: came {describe(answer)}")

    def read_capture(self, tap: Tap, offset: int, count: int, channels: int) -> CaptureData:
        """Read a piece of a capture. Raises NotConforming, TransportError."""
        answer = self.expect(CaptureRead(tap, offset, count), CaptureData)
        if (answer.tap, answer.channels) != (tap, channels):
            raise NotConforming(f"CaptureRead of tap {tap} with {channels} channels: came {describe(answer)}")
        return answer

    def _overlook(self, seconds: float) -> None:
        """Drop all that comes for so long. Raises TransportError."""
        deadline_s = self.link.clock() + seconds
        while self._next_while_alive(deadline_s) is not None:
            pass

    def _next_while_alive(self, deadline_s: float) -> bytes | None:
        """Return the next payload, None if there is none by then; keeps the watchdog content meanwhile."""
        while (payload := self._next(min(deadline_s, self._sent_s + self._max_silence_s))) is None:
            if self.link.clock() >= deadline_s:
                return None
            self.send(pack(StreamData(0, 0, ())))  # without packets it does nothing, and is never answered
        return payload

    def _next(self, deadline_s: float) -> bytes | None:
        """Return the next payload, None if there is none by then. Raises TransportError."""
        while not self._inbox:
            left_s = deadline_s - self.link.clock()
            if left_s <= 0:
                return None
            self._inbox += self._reader.feed(self.link.read(max(_MIN_READ_S, min(_READ_S, left_s))))
        return self._inbox.popleft()

    def _read(self, payload: bytes) -> tuple[int, Message]:
        """Return number and message in a payload; keep notifications. Raises NotConforming for others."""
        if len(payload) > self._limit_bytes:
            raise NotConforming(f"expected payloads of at most {self._limit_bytes} bytes, came one of {len(payload)}")
        try:
            sequence, message = unpack(payload)
        except MessageError as error:
            raise NotConforming(f"expected a message of this protocol, came {payload[:40].hex(' ')}: {error}") from None
        if payload[0] < HelloResponse.TYPE:
            raise NotConforming(f"expected a message of a controller, came {describe(message)}")
        if sequence == NOTIFICATION:
            self.notified.append(message)
        return sequence, message


def name(message: Message) -> str:
    """Return what a message is called in docs/reference/protocol.md."""
    return type(message).__name__


def describe(message: Message) -> str:
    """Return a message in words, for the text of a failure."""
    if isinstance(message, Error):
        code = ErrorCode(message.code).name if message.code in list(ErrorCode) else str(message.code)
        return f"Error {code} ({message.text})"
    text = str(message)
    return text if len(text) < 400 else text[:400] + "..."


def an_error(answer: Message, code: ErrorCode, what: str) -> Error:
    """Return the answer if it is an Error of this code with a text. Raises NotConforming."""
    if not isinstance(answer, Error) or answer.code != code:
        raise NotConforming(f"{what}: expected Error {code.name}, came {describe(answer)}")
    if not answer.text:
        raise NotConforming(f"{what}: expected a text that says why it is rejected, came Error {code.name} without one")
    return answer


def in_state(status: Status, state: State, what: str) -> Status:
    """Return the status if it is of this state. Raises NotConforming."""
    if status.state != state:
        raise NotConforming(f"{what}: expected the state {state.name}, came {describe(status)}")
    return status


def same_samples(came: NDArray[np.int16], expected: NDArray[np.int16], what: str) -> None:
    """Raise NotConforming, with the first difference, unless both int16 (samples, channels) are equal."""
    if came.shape != expected.shape:
        raise NotConforming(f"{what}: expected (samples, channels) {expected.shape}, came {came.shape}")
    different = np.argwhere(came != expected)
    if len(different):
        sample, channel = different[0]
        raise NotConforming(
            f"{what}: {len(different)} of {expected.size} samples differ, the first in channel {channel} at sample "
            f"{sample}: expected {expected[sample, channel]}, came {came[sample, channel]}"
        )
