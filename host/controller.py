"""Client session with a controller: requests, retries, notifications."""

import logging
import math
import random
import time
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from vibrocast.device_protocol.frames import DELIMITER, FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    COUNTERS,
    MAX_SEQUENCE,
    NOTIFICATION,
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    Configure,
    Error,
    ErrorCode,
    Gain,
    Hello,
    HelloResponse,
    Message,
    MessageError,
    PacketMessage,
    Pause,
    Position,
    Resume,
    Status,
    StatusRequest,
    Stop,
    pack,
    unpack,
)
from vibrocast.device_protocol.trace import TappedTransport
from vibrocast.device_protocol.transports import Closing, DeviceGone, Transport, TransportError, selectable
from vibrocast.errors import NO_DEVICE, VibrocastError
from vibrocast.progress import notes

if TYPE_CHECKING:
    from vibrocast.output.sound_card import CardUse

_log = logging.getLogger(__name__)

# docs/reference/protocol.md, "Sequence numbers"
ANSWER_TIMEOUT_S = 0.1
SLOW_BYTES_PER_S = 11_520.0
"""Of a serial port at 115 200 baud: a request may take that much longer to be answered."""
TRIES = 20
HELLO_TRIES = 5
"""Under one sequence number."""
BOOT_S = 5.0
"""How long Hello is said: some boards reset when their port is opened, and then take so long to start."""
MIN_PAYLOAD_LIMIT_BYTES = 256
MIN_WATCHDOG_MS = 50
MAX_DAC_RATE_HZ = 1_000_000
LATE_S = 0.05
"""A machine that wakes up later than this from a wait may itself have caused what looks like a fault."""
# Of the time, and as at most one wait, that other programs may keep this one from a processor.
_QUEUED_SHARE = 0.05
# A controller whose clock has lost so much against this machine's is emulated, and too slow.
_LEAST_SPEED, _LOST_S = 0.98, 0.2

_RECONNECT_PAUSE_S = 0.1
# A clock that goes further back is that of a controller that has restarted.
_REORDERED_US = 100_000

_Answer = TypeVar("_Answer", bound=Message)


class WireFaults(NamedTuple):
    """Frames that went wrong on a wire.

    `bad_frames`, `bad_frames_back`: damaged on the way to the controller, and from it. `repeated_frames`,
    `reordered_frames`: that came twice, or after later ones, on either way.
    """

    bad_frames: int = 0
    bad_frames_back: int = 0
    repeated_frames: int = 0
    reordered_frames: int = 0

    def since(self, before: "WireFaults") -> "WireFaults":
        """Return those that came after others had been counted."""
        return WireFaults(*(now - then for now, then in zip(self, before, strict=True)))


class StatusCounts:
    """Adds up the counts of a controller from Status to Status, over streams and restarts.

    `grown`: of each of COUNTERS, since the first Status. `reordered`: how many came after later ones; their counts are
    old.
    """

    def __init__(self) -> None:
        self.grown = dict.fromkeys(COUNTERS, 0)
        self.reordered = 0
        self._newest: Status | None = None

    def take(self, status: Status) -> None:
        """Take a Status in, in the order in which they come."""
        newest = self._newest or status
        if 0 < newest.device_time_us - status.device_time_us < _REORDERED_US:
            self.reordered += 1
            return
        for name in COUNTERS:
            last, count = getattr(newest, name), getattr(status, name)
            self.grown[name] += count - last if count >= last else count  # a new stream or a restart counts from 0
        self._newest = status


_Result = TypeVar("_Result")

Steps = Generator[float, bytes, _Result]
"""Work in steps: each yields for how many seconds it waits at most, and gets the bytes that came, which may be none.

A step that yields a Sleep waits all that time, and reads nothing. What breaks a transport is raised at the yield.
"""


class Sleep(float):
    """Seconds in which a step reads nothing, as its transport is broken."""


class ControllerError(VibrocastError):
    """A controller that rejected a request, or that does not do what the protocol says.

    `code`: the ErrorCode it answered (or a later one); None if it rejected nothing.
    """

    def __init__(self, problem: str, code: int | None = None, parameter: str | tuple[str, ...] = ()) -> None:
        super().__init__(problem, parameter=parameter)
        self.code = code


class ConnectionLost(ControllerError):
    """A controller that no longer answers, has restarted or has given the host up: `Controller.reconnect` may help."""

    exit_code = NO_DEVICE


@dataclass
class _PendingRequest:
    """A request whose answer is not waited for, when it goes out again, and how often it still may."""

    frame: bytes
    again_s: float
    answer_timeout_s: float
    tries_left: int


class Controller(Closing):
    """A session with the controller behind a transport.

    `description`: what it said in its last hello. `status`: the last Status that came, asked for or not. `may_pause`:
    whether this host has asked it to pause, and not yet to go on. `altered`: whether this host has paused it, stopped
    it or changed its gain since the last Configure, so that its output is no longer that of the stream alone.
    `bytes_sent`, `bytes_received`: all that crossed the transport. `waited_s`: all the time that this host has waited
    for the controller. `late_s`: the most by which it woke up late from a wait since `watch_time`. `repeated_requests`:
    those that this host sent again. Every wait is a read of the transport, measured by `clock`, so that a simulated
    transport can run in simulated time.
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
        self.may_pause = self.altered = False
        self.bytes_sent = 0
        self.bytes_received = 0
        self.waited_s = 0.0
        self.repeated_requests = self._repeated_frames = 0
        self._counts = StatusCounts()
        self._last_payload = b""
        self._answers_due = 0
        self.clock = clock
        self.sleep = sleep
        self._transport = transport
        self.watch_time()
        self._reader = FrameReader()
        self._bad_frames_before = 0  # of earlier connections
        self._sequence = NOTIFICATION
        self._complaint: Error | None = None
        self._pending: _PendingRequest | None = None
        self.device_restarts = 0  # which this host has not requested
        self._has_restarted = False
        self.open_session()
        self._connected_s = clock()

    def watch_time(self) -> None:
        """Begin to note whether this machine and its sound card are in time, and the controller's clock keeps up."""
        self.late_s = 0.0
        self._times_s: list[tuple[float, float]] = []
        self._watched_from_s = time.monotonic(), _queued_s()
        self._card_underruns = 0  # so that `sound_card` has all of them
        self._card_underruns = self.sound_card.underruns if self.sound_card else 0

    def doubt(self, margin_s: float = LATE_S) -> str:
        """Return why this machine may have changed times since `watch_time`; empty where it kept them.

        `margin_s`: it may be so late.
        """
        if self.late_s > margin_s:
            return f"this machine woke up {1e3 * self.late_s:.0f} ms late"
        began_s, queued_s = self._watched_from_s
        seconds, queued_s = time.monotonic() - began_s, _queued_s() - queued_s
        if self.clock is time.monotonic and queued_s > LATE_S + _QUEUED_SHARE * seconds:
            return f"other programs kept this one from a processor for {queued_s:.1f} of {seconds:.1f} s"
        if self._times_s:
            passed_s, device_s = (last - first for first, last in zip(self._times_s[0], self._times_s[-1], strict=True))
            if passed_s - device_s > max(_LOST_S, (1 - _LEAST_SPEED) * passed_s):
                return f"the emulated controller ran at {100 * device_s / passed_s:.0f} % of its speed"
        return ""

    def _note_time(self, status: Status) -> None:
        """Keep the first and the last time of the controller, which a restart begins again."""
        device_s = status.device_time_us / 1e6
        if self._times_s and device_s < self._times_s[-1][1]:
            self._times_s.clear()
        self._times_s[1:] = [(self.clock(), device_s)]

    def _timed(self, wait: Callable[[float], _Result], timeout_s: float) -> _Result:
        """Wait for the controller for at most `timeout_s`, and note how late this machine woke up."""
        began_s = self.clock()
        try:
            return wait(timeout_s)
        finally:
            took_s = self.clock() - began_s
            self.waited_s += min(took_s, timeout_s)
            self.late_s = max(self.late_s, took_s - timeout_s)

    def close(self) -> None:
        """Close the transport."""
        self._transport.close()

    @property
    def sound_card(self) -> "CardUse | None":
        """How the sound card plays that is the DAC, with underruns since `watch_time`; None for other controllers."""
        use: CardUse | None = getattr(self._transport, "sound_card", None)
        return use and replace(use, underruns=use.underruns - self._card_underruns)

    @property
    def wire_faults(self) -> WireFaults:
        """What went wrong on the wire so far; on the way to the controller, since its first Status."""
        there = self._counts.grown
        return WireFaults(
            there["bad_frames"],
            self._bad_frames_before + self._reader.bad_frames,
            there["repeated_frames"] + self._repeated_frames,
            there["reordered_frames"] + self._counts.reordered,
        )

    # ---- what an event loop needs ----

    def make_selectable(self) -> None:
        """Give the transport a file that an event loop can wait for, where it lacks one and can be given one."""
        if isinstance(self._transport, TappedTransport):
            self._transport.make_selectable()
        else:
            self._transport = selectable(self._transport)

    @property
    def file(self) -> Any:
        """The object that `selectors` can wait for; None where the transport has none."""
        return getattr(self._transport, "file", None)

    @property
    def is_sending(self) -> bool:
        """Whether the transport has not taken all bytes yet; `read` hands them on."""
        return bool(getattr(self._transport, "unsent", b""))

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that came, waiting for them at most `timeout_s`. Raises TransportError."""
        data = self._timed(self._transport.read, timeout_s)
        self.bytes_received += len(data)
        return data

    def run(self, steps: Steps[_Result]) -> _Result:
        """Do work with this controller alone, and wait for its end; return its result or raise its error.

        What breaks the transport, and an interruption, is raised in the step that waits.
        """
        step: Callable[[Any], float] = steps.send
        given: Any = None
        try:
            while True:
                wait = step(given)
                step = steps.send
                try:
                    if isinstance(wait, Sleep):
                        self._timed(self.sleep, wait)
                        given = b""
                    else:
                        given = self.read(wait)
                except BaseException as error:
                    step, given = steps.throw, error
        except StopIteration as end:
            result: _Result = end.value
            return result

    # ---- requests: each as steps of an event loop, and as a call that waits ----

    def open_session_steps(self) -> Steps[None]:
        """Say hello and set `description`. Raises as `request`."""
        self._pending = None
        self._write(DELIMITER)  # ends whatever the line has picked up
        description = yield from self._hello_steps()
        if description.major != PROTOCOL_MAJOR:
            raise ControllerError(
                f"the controller speaks protocol {description.major}.{description.minor}, this host "
                f"{PROTOCOL_MAJOR}.{PROTOCOL_MINOR}; update the older one",
                ErrorCode.UNSUPPORTED_VERSION,
            )
        if (
            description.limits.max_payload_bytes < MIN_PAYLOAD_LIMIT_BYTES
            or description.limits.watchdog_ms < MIN_WATCHDOG_MS
            or not 1 <= description.actuator.dac_rate_hz <= MAX_DAC_RATE_HZ
        ):
            raise ControllerError(
                f"the controller announces limits that no host can keep ({description.limits}, "
                f"{description.actuator}); update its firmware"
            )
        self.description = description
        self.device_restarts += self._has_restarted
        self._has_restarted = False
        _log.info("session with %s, %s", description.hardware, description.build)

    def open_session(self) -> None:
        """Open a session, or open it again; sets `description`. Raises as `request`."""
        self.run(self.open_session_steps())

    def _hello_steps(self) -> Steps[HelloResponse]:
        """Return the answer to a Hello under a sequence number that means nothing to the controller yet."""
        for tries in range(HELLO_TRIES, round(BOOT_S / ANSWER_TIMEOUT_S) + 1, HELLO_TRIES):
            # Drawn at random: a late answer to an earlier session is not taken for an answer to this one. Drawn again
            # if the number was one of the last session's, whose copy the controller ignores or answers as it did then.
            self._sequence = random.randrange(MAX_SEQUENCE)
            try:
                return (yield from self.request_steps(Hello(), HelloResponse, tries=HELLO_TRIES))
            except ControllerError as error:
                is_silent = isinstance(error, ConnectionLost) and error.code is None
                if error.code == ErrorCode.UNSUPPORTED_VERSION or (tries >= TRIES and not is_silent):
                    raise
            if is_silent and tries == HELLO_TRIES:
                notes.warning("no answer yet; waiting up to %g s, as a board may reset when its port is opened", BOOT_S)
        raise ConnectionLost(
            f"the controller does not answer within {BOOT_S:g} s; check its power, the address and its baud rate, and "
            "that a board which resets when its port is opened starts in that time"
        )

    def request_steps(
        self,
        message: Message,
        answer_type: type[_Answer],
        answer_timeout_s: float = ANSWER_TIMEOUT_S,
        tries: int = TRIES,
    ) -> Steps[_Answer]:
        """Send a request, as often as it takes, and return its answer; first wait for the answer to an `ask` before.

        Raises ControllerError with the controller's text if it rejects it, ConnectionLost, TransportError,
        MessageError.
        """
        if message.SINCE > 0 and self.description.minor < message.SINCE:
            raise ControllerError(
                f"the controller speaks protocol {self.description.major}.{self.description.minor}, which has no "
                f"{type(message).__name__}; update its firmware",
                ErrorCode.UNKNOWN_MESSAGE,
            )
        while self._pending is not None:
            yield from self.poll_steps(ANSWER_TIMEOUT_S)
        frame = self._next_request(message)
        answer_timeout_s += len(frame) / SLOW_BYTES_PER_S
        for number in range(tries):
            self.repeated_requests += number > 0
            self._write_request(frame)
            deadline_s = self.clock() + answer_timeout_s
            while self.clock() < deadline_s:
                answer = self._take((yield answer_timeout_s))
                if isinstance(answer, Error):
                    raise _rejection(answer)
                if isinstance(answer, answer_type):
                    return answer
                if answer is not None:
                    asked, answered = type(message).__name__, type(answer).__name__
                    raise ControllerError(f"the controller answers {asked} with {answered}; update its firmware")
            _log.debug("no answer to %s within %g s", type(message).__name__, answer_timeout_s)
        raise _no_answer()

    def request(
        self,
        message: Message,
        answer_type: type[_Answer],
        answer_timeout_s: float = ANSWER_TIMEOUT_S,
        tries: int = TRIES,
    ) -> _Answer:
        """Send a request and wait for its answer. Raises as `request_steps`."""
        return self.run(self.request_steps(message, answer_type, answer_timeout_s, tries))

    def request_status(self) -> Status:
        """Ask for the status and return it. Raises as `request_steps`."""
        return self.request(StatusRequest(), Status)

    def stop_steps(self) -> Steps[Status]:
        """Ramp down at once, also after a frame that was cut while it was being written. Raises as `request_steps`."""
        self._pending = None
        self._write(DELIMITER)
        return (yield from self.request_steps(Stop(), Status))

    def stop(self) -> Status:
        """Ramp down at once and wait for the answer. Raises as `request_steps`."""
        return self.run(self.stop_steps())

    def reconnect_steps(self, within_s: float, restarts: bool = False) -> Steps[None]:
        """Open the transport and a session with the same controller again, as often as it takes.

        `restarts`: this host has asked it to restart, so nothing is wrong.
        Raises the last TransportError or ControllerError after `within_s`, and ControllerError for another controller.
        """
        deadline_s = self.clock() + within_s
        lost = f"the connection was lost after {self.clock() - self._connected_s:.1f} s"
        level = logging.DEBUG if restarts else logging.WARNING
        notes.log(level, "%s; trying to open it again for %g s", lost, within_s)
        before = self.description
        while True:
            try:
                self._timed(lambda _: self._transport.reopen(), math.inf)
                self._bad_frames_before += self._reader.bad_frames
                self._reader = FrameReader()
                yield from self.open_session_steps()
                break
            except (TransportError, ConnectionLost) as error:
                if isinstance(error, DeviceGone) or self.clock() >= deadline_s:
                    error.problem = f"{lost}: {error.problem}"
                    raise
            yield Sleep(_RECONNECT_PAUSE_S)
        now = self.description
        if (now.hardware, now.serial_number) != (before.hardware, before.serial_number):
            raise ControllerError(
                f"{lost}, and another controller is there now ({now.hardware} {now.serial_number}); connect "
                f"{before.hardware} {before.serial_number} again"
            )
        notes.log(level, "the connection is back")

    def reconnect(self, within_s: float, restarts: bool = False) -> None:
        """Open the transport and a session again, and wait for it, as `reconnect_steps` does."""
        self.run(self.reconnect_steps(within_s, restarts))

    # ---- what is sent without waiting for an answer ----

    def send(self, data: PacketMessage | Position) -> None:
        """Send stream data, which is never answered. Raises TransportError."""
        self._write(write_frame(pack(data)))

    def ask(self, message: Message, answer_timeout_s: float = ANSWER_TIMEOUT_S) -> None:
        """Send a request, which `poll` sends again until its answer comes; no other one may be under way."""
        frame = self._next_request(message)
        self._write_request(frame)
        self._pending = _PendingRequest(frame, self.clock() + answer_timeout_s, answer_timeout_s, TRIES - 1)

    def ask_status(self) -> None:
        """Ask for the status once; `poll` brings it. Raises TransportError.

        While another request waits for its answer, nothing is sent: one is under way at a time.
        """
        if self._pending is None:
            self.ask_once(StatusRequest())

    def ask_once(self, message: Message) -> None:
        """Send a request once; `poll` brings its answer, unless one of the two is lost. Raises TransportError."""
        self._write_request(self._next_request(message))

    def poll_steps(self, timeout_s: float) -> Steps[Message | None]:
        """Receive messages for at most `timeout_s`; return the answer to the request.

        Raises TransportError, ConnectionLost, and ControllerError if the controller rejects something or complains.
        """
        if self._pending is not None and self.clock() >= self._pending.again_s:
            if not self._pending.tries_left:
                raise _no_answer()
            self.repeated_requests += 1
            self._write_request(self._pending.frame)
            self._pending.again_s = self.clock() + self._pending.answer_timeout_s
            self._pending.tries_left -= 1
        answer = self._take((yield timeout_s))
        if answer is not None:
            self._pending = None
        if isinstance(answer, Error):
            raise _rejection(answer)
        if self._complaint is not None:
            complaint, self._complaint = self._complaint, None
            raise _rejection(complaint)
        return answer

    def poll(self, timeout_s: float) -> Message | None:
        """Receive messages for at most `timeout_s`. Returns and raises as `poll_steps`."""
        return self.run(self.poll_steps(timeout_s))

    # ---- frames ----

    def _next_request(self, message: Message) -> bytes:
        """Return the frame of a new request."""
        if isinstance(message, (Pause, Resume, Configure, Stop)):
            self.may_pause = isinstance(message, Pause)
        if isinstance(message, (Pause, Gain, Stop, Configure)):
            self.altered = not isinstance(message, Configure)
        self._sequence = self._sequence % MAX_SEQUENCE + 1
        self._answers_due = 0
        return write_frame(pack(message, self._sequence))

    def _write_request(self, frame: bytes) -> None:
        self._write(frame)
        self._answers_due += 1

    def _count(self, sequence: int, message: Message, payload: bytes) -> None:
        """Count what went wrong on the wire with this frame, or as this Status says."""
        repeated = isinstance(message, Status) and sequence == NOTIFICATION and payload == self._last_payload
        if sequence == self._sequence:
            self._answers_due -= 1
            repeated = self._answers_due < 0
        self._repeated_frames += repeated
        self._last_payload = payload
        if isinstance(message, Status) and not repeated:
            self._counts.take(message)

    def _write(self, data: bytes) -> None:
        self._timed(lambda _: self._transport.write(data), math.inf)  # one that is stuck waits for the link
        self.bytes_sent += len(data)

    def _take(self, data: bytes) -> Message | None:
        """Take in bytes that came; note notifications; return the answer to the last request, if it came."""
        answer = None
        for payload in self._reader.feed(data):
            try:
                sequence, message = unpack(payload)
            except MessageError:
                continue  # a later minor version may send what this one does not know
            self._count(sequence, message, payload)
            self._has_restarted |= isinstance(message, Error) and message.code == ErrorCode.HELLO_FIRST
            if isinstance(message, Status) and sequence in (NOTIFICATION, self._sequence):
                self.status = message
                self._note_time(message)
            if sequence == self._sequence:
                answer = message
            elif sequence == NOTIFICATION and isinstance(message, Error):
                self._complaint = message
        return answer


def _queued_s() -> float:
    """Return for how long all threads of this process together have been ready to run, and had to wait.

    0 where the system does not count it; Linux does.
    """
    queued_ns = 0
    for task in Path("/proc/self/task").glob("*/schedstat"):
        with suppress(OSError, IndexError):  # the thread has ended
            queued_ns += int(task.read_text().split()[1])  # Documentation/scheduler/sched-stats.rst of Linux
    return queued_ns / 1e9


_UPDATE = "update the older of vibrocast and the firmware"
# The controller's own texts say the rest.
_REMEDIES: dict[int, str] = {
    ErrorCode.UNKNOWN_MESSAGE: _UPDATE,
    ErrorCode.MALFORMED: _UPDATE,
    ErrorCode.UNKNOWN_CODEC: "`vibrocast status` lists its codecs",
    ErrorCode.BEYOND_LIMITS: "`vibrocast status` lists its limits",
    ErrorCode.WRONG_HARDWARE: "give an image for this controller",
}


def _no_answer() -> ConnectionLost:
    return ConnectionLost(
        "the controller answers no more; check its power, its cable, and that the link carries the stream's bit rate"
    )


def _rejection(error: Error) -> ControllerError:
    if error.code == ErrorCode.HELLO_FIRST:
        return ConnectionLost("the controller has restarted, which ends the session; run the command again", error.code)
    reason = error.text or f"no reason given (error {error.code})"
    remedy = _REMEDIES.get(error.code)
    return ControllerError(f"the controller rejects the request: {reason}{f'; {remedy}' if remedy else ''}", error.code)
