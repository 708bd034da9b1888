"""Client session with a tactor controller: requests, retries, notifications. No threads: it runs in the caller's."""

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self, TypeVar

from vibrocast.device_protocol.frames import DELIMITER, FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    MAXIMUM_SEQUENCE,
    NOTIFICATION,
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    CaptureData,
    CaptureRead,
    Error,
    ErrorCode,
    Hello,
    HelloResponse,
    Message,
    MessageError,
    Position,
    Status,
    StatusRequest,
    Stop,
    StreamData,
    Tap,
    pack,
    unpack,
)
from vibrocast.device_protocol.transports import Transport, TransportError

# docs/protocol.md, "Sequence numbers"
ANSWER_TIMEOUT_S = 0.1
TRIES = 20
HELLO_TRIES = 5
SMALLEST_PAYLOAD_LIMIT_BYTES = 256
SMALLEST_WATCHDOG_MS = 50
LARGEST_DAC_RATE_HZ = 1_000_000

_RECONNECT_PAUSE_S = 0.1

_Answer = TypeVar("_Answer", bound=Message)


class ControllerError(RuntimeError):
    """A controller that refused, or that does not do what the protocol says.

    `code`: the ErrorCode it answered (or a later one); None if it did not refuse.
    """

    def __init__(self, text: str, code: int | None = None) -> None:
        super().__init__(text)
        self.code = code


class ConnectionLost(ControllerError):
    """A controller that no longer answers, has restarted or has given the host up: `Controller.reconnect` may help."""


@dataclass
class _Asked:
    """A request whose answer is not waited for, when it goes out again, and how often it still may."""

    frame: bytes
    again_s: float
    answer_timeout_s: float
    tries_left: int


class Controller:
    """A session with the controller behind a transport.

    `description`: what it said in its last hello. `status`: the last Status that came, asked for or not.
    `bytes_sent`, `bytes_received`: all that crossed the transport. Every wait is a read of the transport, measured by
    `clock`, so that a simulated transport can run in simulated time.
    """

    description: HelloResponse

    def __init__(
        self,
        transport: Transport,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Say hello. Raises ControllerError (also for another protocol version) and TransportError."""
        self.status: Status | None = None
        self.bytes_sent = 0
        self.bytes_received = 0
        self.clock = clock
        self.sleep = sleep
        self._transport = transport
        self._reader = FrameReader()
        self._sequence = NOTIFICATION
        self._complaint: Error | None = None
        self._asked: _Asked | None = None
        self.say_hello()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the transport."""
        self._transport.close()

    def say_hello(self) -> None:
        """Open a session, or open it anew; sets `description`. Raises as `request`."""
        self._asked = None
        self._write(DELIMITER)  # ends whatever the line has picked up
        description = self._greet()
        if description.major != PROTOCOL_MAJOR:
            raise ControllerError(
                f"the controller speaks protocol {description.major}.{description.minor}, this host "
                f"{PROTOCOL_MAJOR}.{PROTOCOL_MINOR}: update the older one",
                ErrorCode.UNSUPPORTED_VERSION,
            )
        if (
            description.limits.maximum_payload_bytes < SMALLEST_PAYLOAD_LIMIT_BYTES
            or description.limits.watchdog_ms < SMALLEST_WATCHDOG_MS
            or not 1 <= description.actuator.dac_rate_hz <= LARGEST_DAC_RATE_HZ
        ):
            raise ControllerError(
                f"the controller announces what no host can keep to ({description.limits}, {description.actuator}): "
                "update its firmware"
            )
        self.description = description

    def _greet(self) -> HelloResponse:
        """Return the answer to a Hello under a sequence number that means nothing to the controller yet."""
        tries_left = TRIES
        while True:
            # Drawn at random: a late answer to an earlier session is not taken for an answer to this one. Drawn again
            # if the number was one of the last session's, whose copy the controller ignores or answers as it did then.
            self._sequence = random.randrange(MAXIMUM_SEQUENCE)
            tries_left -= HELLO_TRIES
            try:
                return self.request(Hello(), HelloResponse, tries=HELLO_TRIES)
            except ControllerError as error:
                if tries_left <= 0 or error.code == ErrorCode.UNSUPPORTED_VERSION:
                    raise

    def request(
        self,
        message: Message,
        answer_type: type[_Answer],
        answer_timeout_s: float = ANSWER_TIMEOUT_S,
        tries: int = TRIES,
    ) -> _Answer:
        """Send a request, as often as it takes, and return its answer.

        Raises ControllerError with the controller's text if it refuses, ConnectionLost, TransportError, MessageError.
        """
        frame = self._next_request(message)
        for _ in range(tries):
            self._write(frame)
            deadline_s = self.clock() + answer_timeout_s
            while self.clock() < deadline_s:
                answer = self._receive(answer_timeout_s)
                if isinstance(answer, Error):
                    raise _refusal(answer)
                if isinstance(answer, answer_type):
                    return answer
                if answer is not None:
                    asked, answered = type(message).__name__, type(answer).__name__
                    raise ControllerError(f"the controller answers {asked} with {answered}: update its firmware")
        raise _no_answer()

    def send(self, data: StreamData | Position) -> None:
        """Send stream data, which is never answered. Raises TransportError."""
        self._write(write_frame(pack(data)))

    def ask(self, message: Message, answer_timeout_s: float = ANSWER_TIMEOUT_S) -> None:
        """Send a request without waiting for its answer: `poll` sends it again until it comes. Raises as `request`."""
        frame = self._next_request(message)
        self._write(frame)
        self._asked = _Asked(frame, self.clock() + answer_timeout_s, answer_timeout_s, TRIES - 1)

    def ask_status(self) -> None:
        """Ask for the status without waiting for it; `poll` brings it. Raises TransportError.

        While another request waits for its answer, nothing is sent: one is under way at a time.
        """
        if self._asked is None:
            self._write(self._next_request(StatusRequest()))

    def ask_capture(self, tap: Tap, offset: int, channels: int) -> None:
        """Ask for a frame of captured samples without waiting for it; `poll` brings it. Raises TransportError."""
        self._write(self._next_request(CaptureRead(tap, offset, self.capture_room(channels))))

    def poll(self, timeout_s: float) -> Message | None:
        """Take in what the controller sends, waiting for it at most `timeout_s`; return the answer to what was asked.

        Raises TransportError, ConnectionLost, and ControllerError if the controller refuses or complains.
        """
        if self._asked is not None and self.clock() >= self._asked.again_s:
            if not self._asked.tries_left:
                raise _no_answer()
            self._write(self._asked.frame)
            self._asked.again_s = self.clock() + self._asked.answer_timeout_s
            self._asked.tries_left -= 1
        answer = self._receive(timeout_s)
        if answer is not None:
            self._asked = None
        if isinstance(answer, Error):
            raise _refusal(answer)
        if self._complaint is not None:
            complaint, self._complaint = self._complaint, None
            raise _refusal(complaint)
        return answer

    def request_status(self) -> Status:
        """Ask for the status and return it. Raises as `request`."""
        return self.request(StatusRequest(), Status)

    def stop(self) -> Status:
        """Ramp down at once, also after a frame that was cut while it was being written. Raises as `request`."""
        self._asked = None
        self._write(DELIMITER)
        return self.request(Stop(), Status)

    def capture_room(self, channels: int) -> int:
        """Return how many captured samples per channel one frame holds."""
        fixed_bytes = len(pack(CaptureData(Tap.DAC, channels, 0, 0, b"")))
        return (self.description.limits.maximum_payload_bytes - fixed_bytes) // (2 * channels)

    def read_capture(self, tap: Tap, offset: int, count: int, channels: int) -> CaptureData:
        """Return up to `count` captured samples per channel from `offset`, as many as one frame holds.

        Raises as `request`, and ControllerError if the first of them is no longer there.
        """
        captured = self.request(CaptureRead(tap, offset, min(count, self.capture_room(channels))), CaptureData)
        return self.checked_capture(captured, tap, offset, channels)

    def checked_capture(self, captured: CaptureData, tap: Tap, offset: int, channels: int) -> CaptureData:
        """Return captured samples if they are those asked for. Raises ControllerError."""
        if captured.tap != tap or captured.channels != channels or captured.offset != offset:
            raise ControllerError(
                f"the controller has no {tap.name.lower()} capture from sample {offset} of {channels} channels: "
                f"it keeps the last {self.description.limits.capture_samples} samples. Play without the read-back."
            )
        return captured

    def reconnect(self, within_s: float) -> None:
        """Open the transport anew and say hello, again and again until it works.

        Raises the last TransportError or ControllerError after `within_s`.
        """
        deadline_s = self.clock() + within_s
        while True:
            try:
                self._transport.reopen()
                self._reader = FrameReader()
                self.say_hello()
                return
            except (TransportError, ConnectionLost):
                if self.clock() >= deadline_s:
                    raise
            self.sleep(_RECONNECT_PAUSE_S)

    def _next_request(self, message: Message) -> bytes:
        """Return the frame of a new request, the one that is waited for, once an `ask` before it is answered."""
        while self._asked is not None:
            self.poll(ANSWER_TIMEOUT_S)
        self._sequence = self._sequence % MAXIMUM_SEQUENCE + 1
        return write_frame(pack(message, self._sequence))

    def _write(self, data: bytes) -> None:
        self._transport.write(data)
        self.bytes_sent += len(data)

    def _receive(self, timeout_s: float) -> Message | None:
        """Read once; note notifications; return the answer to the last request, if it came."""
        data = self._transport.read(timeout_s)
        self.bytes_received += len(data)
        answer = None
        for payload in self._reader.feed(data):
            try:
                sequence, message = unpack(payload)
            except MessageError:
                continue  # a later minor version may send what this one does not know
            if isinstance(message, Status) and sequence in (NOTIFICATION, self._sequence):
                self.status = message
            if sequence == self._sequence:
                answer = message
            elif sequence == NOTIFICATION and isinstance(message, Error):
                self._complaint = message
        return answer


def _no_answer() -> ConnectionLost:
    return ConnectionLost(
        "the controller does not answer. Check that it has power and that the address is the right one."
    )


def _refusal(error: Error) -> ControllerError:
    if error.code == ErrorCode.HELLO_FIRST:
        return ConnectionLost("the controller has restarted and knows nothing of this session", error.code)
    return ControllerError(f"the controller refuses: {error.text or 'no reason given'}", error.code)
