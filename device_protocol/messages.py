"""Messages between host and controller, as dataclasses, from which C sources and docs/reference/protocol.md follow."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated, ClassVar, NamedTuple, Self, TypeAlias

from vibrocast.device_protocol.layout import (
    COUNTED_TEXT,
    F32,
    FACTOR,
    FLAG,
    I64,
    MAX_VARINT_BYTES,
    SHA256,
    SHA256_BYTES,
    U8,
    U16,
    U32,
    U64,
    VARINT,
    BadValueError,
    Layout,
    Tag,
    rest,
    rest_items,
    rest_text,
)
from vibrocast.errors import VibrocastError

PROTOCOL_MAJOR = 2
PROTOCOL_MINOR = 2

NOTIFICATION = 0
"""The sequence number of a message that answers no request."""
MAX_SEQUENCE = 0xFFFF

FIRST_UNSEQUENCED = 0x40
FIRST_FROM_CONTROLLER = 0x80
SEQUENCED_HEAD = struct.Struct("<BH")
STREAM_DATA_HEAD_BYTES = 1 + 1 + MAX_VARINT_BYTES
"""Bytes of a StreamData before its packets, at most: type, stream, iteration."""
PACKET_OVERHEAD_BYTES = STREAM_DATA_HEAD_BYTES + MAX_VARINT_BYTES
"""Bytes of a StreamData in addition to its only packet, at most."""


KEY_BYTES = 32
"""Of a key of Ed25519."""


class Described(IntEnum):
    """A number of the protocol with its row in docs/reference/protocol.md."""

    description: str

    def __new__(cls, number: int, description: str = "") -> Self:
        """Return the member of a number."""
        member = int.__new__(cls, number)
        member._value_ = number
        member.description = description
        return member


class ErrorCode(Described):
    """Why a controller rejected a request."""

    UNKNOWN_MESSAGE = 1, "this version does not have the message type"
    MALFORMED = 2, "lengths or values are unreadable, or a tag is missing"
    UNSUPPORTED_VERSION = 3, "the controller speaks another major version; the text names both"
    HELLO_FIRST = 4, "no session is open, or the controller has restarted"
    WRONG_STATE = 5, "the state does not allow the request, such as Start without Configure"
    BAD_VALUE = 6, "a readable value makes no sense, such as an absent tap, an unknown flag or a negative gain"
    UNKNOWN_CODEC = 7, "the controller does not support the stream's codec or its configuration"
    UNKNOWN_IMAGE = 8, "the stream names a model image that does not run; the text names it"
    BEYOND_LIMITS = 9, "a rate, a size or a number of channels exceeds the controller's limits"
    NO_SUCH_SLOT = 10, "the slot does not exist"
    WRONG_HARDWARE = 11, "the image is for other hardware"
    IMAGE_REJECTED = 12, "the image's hash, CRC, contents, signature or number are wrong"
    FLASH_FAILED = 13, "the flash memory did not take the data"


class State(Described):
    """The state of the controller's stream."""

    IDLE = 0, "nothing is configured"
    BUFFERING = 1, "configured; takes data and waits for Start"
    ARMED = 2, "started; waits for the start time and the prebuffer"
    PLAYING = 3, "time runs, with or without data"
    PAUSED = 4, "faded out; the position stays"
    FINISHED = 5, "played to the end; the output is at rest"
    STOPPED = 6, "stopped by the host"
    WATCHDOG = 7, "ramped down because the host was silent"
    FAULT = 8, "ramped down because the hardware failed"


class Tap(IntEnum):
    """The content of a capture: decoded samples at the stream's rate, or DAC codes at the DAC's rate."""

    DECODED = 0
    DAC = 1


class SlotState(IntEnum):
    """The state of a slot for model images."""

    EMPTY = 0
    WRITING = 1
    VERIFIED = 2
    TESTING = 3
    CONFIRMED = 4


class MessageError(VibrocastError, ValueError):
    """A message that cannot be packed, or bytes that are no message.

    `sequence` is the sequence number to answer with (0: none could be read, or the type takes no answer) and `code`
    the ErrorCode to answer.
    """

    def __init__(self, text: str, code: ErrorCode = ErrorCode.MALFORMED, sequence: int = NOTIFICATION) -> None:
        super().__init__(text)
        self.sequence = sequence
        self.code = code


class Message:
    """A message. `TYPE`: its number; 0: the class is none itself. `ANSWER`: what a controller answers it with. `SINCE`:
    the minor version that brought it.

    Values are checked where a message is packed or unpacked. The dataclasses are not frozen: that would make
    unpacking a Status twice as slow.
    """

    TYPE: ClassVar[int] = 0
    ANSWER: ClassVar[str] = "Status"
    SINCE: ClassVar[int] = 0
    LAYOUT: ClassVar[Layout]
    FIXED: ClassVar[struct.Struct]
    HEAD: ClassVar[bytes]
    """The header of a message without a sequence number; b"" for others."""

    def __init_subclass__(cls) -> None:
        cls.LAYOUT = Layout(cls)
        cls.FIXED = cls.LAYOUT.fixed
        cls.HEAD = bytes((cls.TYPE,)) if FIRST_UNSEQUENCED <= cls.TYPE < FIRST_FROM_CONTROLLER else b""

    def body(self) -> bytes:
        """Return the bytes after the header. Raises MessageError for a value that its field cannot hold."""
        return pack(self)[len(self.HEAD) or SEQUENCED_HEAD.size :]


def _message_error(kind: type[Message], error: ValueError, sequence: int = NOTIFICATION) -> MessageError:
    code = ErrorCode.BAD_VALUE if isinstance(error, BadValueError) else ErrorCode.MALFORMED
    return MessageError(f"{kind.__name__}: {error}", code, sequence)


# ---- from the host: requests ----


@dataclass
class Hello(Message):
    """Opens a session, with the host's protocol version. The layout is the same in every version."""

    TYPE = 0x01
    ANSWER = "HelloResponse"

    major: U8 = PROTOCOL_MAJOR
    minor: U8 = PROTOCOL_MINOR


@dataclass
class StatusRequest(Message):
    """Asks for a Status; also counts for the watchdog."""

    TYPE = 0x02


@dataclass
class StreamSetup(Message):
    """What a controller must know of a stream.

    `stream`: the host's number for it, 0-255. `packets`: in one iteration, 0 = unknown (live). `first_packet`: the
    refresh at which playing begins. `loops`: iterations, 0 = until stopped. `gain`: factor on the signal. `header`:
    the bytes of `coded_stream.StreamHeader`.
    """

    stream: U8
    compensation: FLAG = field(default=True, kw_only=True)
    header: Annotated[bytes, Tag(0x01, "stream header, as in a `.vct` file")]
    prebuffer_samples: U32
    packets: U32 = 0
    first_packet: U32 = 0
    loops: U16 = 1
    gain: FACTOR = 1.0


@dataclass
class Configure(StreamSetup):
    """Stops the present stream and sets up another."""

    TYPE = 0x03


@dataclass
class Queue(StreamSetup):
    """Sets a stream up behind the one under way, which it follows without a gap; since version 2.2.

    It has the rate, channels, unit and full scales of the stream before it, and its gain and compensation.
    """

    TYPE = 0x0C
    SINCE = 2


@dataclass
class Start(Message):
    """Starts the configured stream at a device time; 0 or a past time: as soon as the prebuffer is there."""

    TYPE = 0x04

    device_time_us: U64 = 0


@dataclass
class Pause(Message):
    """Fades out and holds the position."""

    TYPE = 0x05


@dataclass
class Resume(Message):
    """Fades in at the position that Pause held."""

    TYPE = 0x06


@dataclass
class Stop(Message):
    """Ramps down at once and drops the stream. Valid in every state, also before Hello."""

    TYPE = 0x07


@dataclass
class Loop(Message):
    """Sets the iterations of the stream, including those already played; 0 = until stopped."""

    TYPE = 0x08

    loops: U16


@dataclass
class Gain(Message):
    """Moves the gain to a new factor, along a ramp."""

    TYPE = 0x09

    gain: FACTOR


@dataclass
class EndStream(Message):
    """Sets the number of packets of a live stream, so that its end is no underrun."""

    TYPE = 0x0A

    stream: U8
    packets: U32


@dataclass
class CaptureRead(Message):
    """Asks for `count` captured samples per channel, from `offset` samples after the start of the stream."""

    TYPE = 0x0B
    ANSWER = "CaptureData"

    tap: Tap
    offset: U64
    count: U16


@dataclass
class FlashBegin(Message):
    """Announces a model image for a slot. The same image as before goes on where it was cut."""

    TYPE = 0x10
    ANSWER = "FlashStatus"

    slot: U8
    size_bytes: U32
    sha256: SHA256
    hardware: Annotated[str, Tag(0x01, "hardware id (text)")]


@dataclass
class FlashData(Message):
    """Carries a piece of the image."""

    TYPE = 0x11
    ANSWER = "FlashStatus"

    slot: U8
    offset: U32
    data: Annotated[bytes, rest("data")]


@dataclass
class FlashVerify(Message):
    """Asks the controller to read the slot back and check it."""

    TYPE = 0x12
    ANSWER = "FlashStatus"

    slot: U8


@dataclass
class FlashActivate(Message):
    """Restarts the controller to test a verified slot. Unless confirmed, the next restart reverts it."""

    TYPE = 0x13
    ANSWER = "FlashStatus, then a restart"

    slot: U8


@dataclass
class FlashConfirm(Message):
    """Keeps the slot under test."""

    TYPE = 0x14
    ANSWER = "FlashStatus"

    slot: U8


@dataclass
class FlashErase(Message):
    """Empties a slot that neither runs nor is the one to fall back to; since version 2.2."""

    TYPE = 0x15
    SINCE = 2
    ANSWER = "FlashStatus"

    slot: U8


@dataclass
class FlashRead(Message):
    """Asks for up to `count` bytes of the image in a slot, from `offset` on; since version 2.2."""

    TYPE = 0x16
    SINCE = 2
    ANSWER = "FlashContents"

    slot: U8
    offset: U32
    count: U16


# ---- from the host: stream data, never answered ----


@dataclass
class StreamData(Message):
    """Packets of a stream, each as `coded_stream.packet_sequence` reads it; `iteration` counts loops from 0."""

    TYPE = 0x40
    ANSWER = "none"

    stream: U8
    iteration: VARINT
    packets: Annotated[tuple[bytes, ...], rest_items("packets, each as length varint and bytes")]


@dataclass
class Position(Message):
    """Where the hand was at a device time (0 = on arrival), from any origin, for all channels."""

    TYPE = 0x41
    ANSWER = "none"

    device_time_us: U64
    position_nm: I64


@dataclass
class SinglePacket(Message):
    """One packet of iteration 0, in the fewest bytes: what StreamData would carry alone."""

    TYPE = 0x42
    ANSWER = "none"

    stream: U8
    packet: Annotated[bytes, rest("packet")]

    @property
    def iteration(self) -> int:
        """As StreamData has it."""
        return 0

    @property
    def packets(self) -> tuple[bytes, ...]:
        """As StreamData has them."""
        return (self.packet,)


PacketMessage: TypeAlias = StreamData | SinglePacket


# ---- from the controller: responses, and notifications of the same layout ----


@dataclass(frozen=True)
class Limits:
    """The controller's limits. `watchdog_ms`: longest silence of the host while armed, playing or paused.

    `profile_samples`: of a height profile, all channels together; 0: no profiles. `packet_samples`: of the longest
    packet, per channel. `decoding_kilocycles_per_s`: what a second of a stream may take to decode, in thousands of
    Cortex-M4 cycles; 0: any stream is decoded in time.
    """

    max_payload_bytes: U16
    max_packet_bytes: U16
    buffer_samples: U32
    capture_samples: U32
    channels: U8
    min_rate_hz: U32
    max_rate_hz: U32
    watchdog_ms: U16
    profile_samples: U32 = 0
    packet_samples: U32 = 0
    decoding_kilocycles_per_s: U32 = 0

    @property
    def sendable_packet_bytes(self) -> int:
        """Bytes of the longest packet that a frame carries to this controller."""
        return min(self.max_packet_bytes, self.max_payload_bytes - PACKET_OVERHEAD_BYTES)


@dataclass(frozen=True)
class ActuatorDescription:
    """The actuator with its amplifier and DAC.

    `stroke_um`: displacement at `volts`. `lower_hz`, `upper_hz`: -3 dB; a lower one of 0: down to rest.
    `slew_volts_per_second`: 0 = no limit.
    """

    name: Annotated[str, rest_text("name")]
    stroke_um: F32
    volts: F32
    lower_hz: F32
    upper_hz: F32
    slew_volts_per_second: F32
    dac_bits: U8
    dac_rate_hz: U32


class CodecDescription(NamedTuple):
    """A codec that the controller decodes."""

    identifier: U8
    name: Annotated[str, rest_text("name")]


@dataclass(frozen=True)
class ImageDescription:
    """A slot and the model image in it. `sha256`: of the image without its number and signature. `number`: of a signed
    image, 0 = unsigned.
    """

    slot: U8
    state: SlotState
    sha256: SHA256 = bytes(SHA256_BYTES)
    number: U32 = field(default=0, kw_only=True)
    name: COUNTED_TEXT = ""
    version: Annotated[str, rest_text("version")] = ""


@dataclass
class HelloResponse(Message):
    """The controller's version, limits, actuator, codecs and model images.

    `public_key`: of Ed25519; model images need its signature. Empty: they need none. `serial_number`: of the board;
    empty: it has none.
    """

    TYPE = 0x80

    major: U8 = field(default=PROTOCOL_MAJOR, kw_only=True)
    minor: U8 = field(default=PROTOCOL_MINOR, kw_only=True)
    build: Annotated[str, Tag(0x01, "build (text)")]
    hardware: Annotated[str, Tag(0x02, "hardware id (text)")]
    limits: Annotated[Limits, Tag(0x03, "limits")]
    actuator: Annotated[ActuatorDescription, Tag(0x04, "actuator")]
    codecs: Annotated[tuple[CodecDescription, ...], Tag(0x05, "codec, one for each")]
    images: Annotated[tuple[ImageDescription, ...], Tag(0x06, "model image, one for each slot")] = ()
    public_key: Annotated[bytes, Tag(0x07, "public key, 32 bytes; empty or absent: images need no signature")] = b""
    serial_number: Annotated[str, Tag(0x08, "serial number (text); empty or absent: the board has none")] = ""

    def check(self) -> None:
        """Raise ValueError for a public key of another length."""
        if len(self.public_key) not in (0, KEY_BYTES):
            raise ValueError(f"a public key has {KEY_BYTES} bytes, not {len(self.public_key)}")

    @property
    def image_lines(self) -> list[str]:
        """One line for people about each slot that holds a model image."""
        return [
            f"slot {image.slot}: {image.name} {image.version}, {image.state.name.lower()}, {image.sha256.hex()[:16]}"
            + (f", number {image.number}" if image.number else "")
            for image in self.images
            if image.state != SlotState.EMPTY
        ]


@dataclass(frozen=True)
class CodingDescription:
    """How a stream is coded. `packet_samples`: per channel in a packet. `delay_samples`: by which the decoder lags."""

    packet_samples: U32
    delay_samples: U32


@dataclass
class QueuedStream:
    """The stream behind the one under way: its number, and up to where data of it may be sent, in its positions."""

    stream: U8
    credit_until: U64


@dataclass
class OutputFaults:
    """Faults of the chip behind the controller since Configure.

    `refused`: values that it did not take. `restarts`: how often it was set up again.
    """

    refused: U32
    restarts: U32


@dataclass
class FrameFaults:
    """Frames with stream data or a position that came out of turn since the controller started.

    `repeated`: brought again what had come. `reordered`: came after later ones.
    """

    repeated: U32
    reordered: U32


@dataclass
class Status(Message):
    """State, position, credit and counts: the answer to most requests, and the notification that grants credit.

    Positions and credit count samples per channel, over all iterations. `credit_until`: the controller takes packets
    that end at or before this position. `buffered_samples`: received and not yet played. `bad_frames` counts since the
    controller started, the fields after it since Configure. `output_gaps`: how often the DAC had no sample while it was
    away from rest; `late_samples`: for how many of its samples. `signed_images`: model images need a signature.
    `coding`: in the answers to Configure and Queue alone, since version 2.1. `queued`: while a stream is set up behind
    the one under way, since version 2.2. `output_faults`, `frame_faults`: once there are any, since version 2.2.
    """

    TYPE = 0x81

    state: State
    stream: U8
    device_time_us: U64
    position: U64
    credit_until: U64
    buffered_samples: U32
    bad_frames: U32
    underruns: U32
    lost_packets: U32
    compensation_clipped: U32
    voltage_limited: U32
    slew_limited: U32
    power_limited: U32
    output_gaps: U32 = 0
    late_samples: U32 = 0
    signed_images: FLAG = False
    coding: Annotated[CodingDescription | None, Tag(0x01, "coding, in the answers to Configure and Queue")] = None
    queued: Annotated[QueuedStream | None, Tag(0x02, "queued, while a stream waits behind the one under way")] = None
    output_faults: Annotated[OutputFaults | None, Tag(0x03, "output faults, once there are any")] = None
    frame_faults: Annotated[FrameFaults | None, Tag(0x04, "frame faults, once there are any")] = None

    @property
    def output_refused(self) -> int:
        """How many values the output did not take since Configure."""
        return 0 if self.output_faults is None else self.output_faults.refused

    @property
    def output_restarts(self) -> int:
        """How often the output was set up again since Configure."""
        return 0 if self.output_faults is None else self.output_faults.restarts

    @property
    def repeated_frames(self) -> int:
        """How many frames brought again what had come, since the controller started."""
        return 0 if self.frame_faults is None else self.frame_faults.repeated

    @property
    def reordered_frames(self) -> int:
        """How many frames came after later ones, since the controller started."""
        return 0 if self.frame_faults is None else self.frame_faults.reordered


COUNTERS = (
    "bad_frames",
    "repeated_frames",
    "reordered_frames",
    "underruns",
    "lost_packets",
    "compensation_clipped",
    "voltage_limited",
    "slew_limited",
    "power_limited",
    "output_gaps",
    "late_samples",
    "output_refused",
    "output_restarts",
)
"""Fields of Status that count what went wrong."""


@dataclass
class CaptureData(Message):
    """Captured samples, int16 little-endian, channels interleaved.

    `offset`: of the first sample, later than requested if the controller no longer has that one. `end`: samples per
    channel captured so far.
    """

    TYPE = 0x82

    tap: Tap
    channels: U8
    offset: U64
    end: U64
    data: Annotated[bytes, rest("int16, channels interleaved")]

    def check(self) -> None:
        """Raise ValueError where the data are no whole number of samples of each channel."""
        if self.channels < 1 or len(self.data) % (2 * self.channels):
            raise ValueError(f"{len(self.data)} bytes are no int16 samples of {self.channels} channels")


@dataclass
class FlashStatus(Message):
    """Answers every flash request. `next_offset`: where data must go on. `sha256`: zeros until verified."""

    TYPE = 0x83

    slot: U8
    state: SlotState
    next_offset: U32
    sha256: SHA256 = bytes(SHA256_BYTES)


@dataclass
class FlashContents(Message):
    """Bytes of the image in a slot, from `offset` on. `size_bytes`: of the whole image. Since version 2.2."""

    TYPE = 0x84

    slot: U8
    size_bytes: U32
    offset: U32
    data: Annotated[bytes, rest("data")]


@dataclass
class Error(Message):
    """A rejection: an ErrorCode (or a later one) and a text. The layout is the same in every version."""

    TYPE = 0xFF

    code: U16
    text: Annotated[str, Tag(0x01, "text")] = ""


def _kinds(owner: type[Message]) -> Iterator[type[Message]]:
    """Yield the messages in the order of their declaration."""
    for kind in owner.__subclasses__():
        yield from _kinds(kind) if kind.__subclasses__() else (kind,)


ALL: tuple[type[Message], ...] = tuple(_kinds(Message))
REQUESTS = tuple(message for message in ALL if message.TYPE < FIRST_UNSEQUENCED)
FROM_HOST = tuple(message for message in ALL if message.TYPE < FIRST_FROM_CONTROLLER)
RESPONSES = tuple(message for message in ALL if message.TYPE >= FIRST_FROM_CONTROLLER)
MESSAGES = {message.TYPE: message for message in ALL}


def pack(message: Message, sequence: int = NOTIFICATION) -> bytes:
    """Return a message as the payload of a frame. Stream data carries no sequence number.

    Raises MessageError for a value out of its field's range.
    """
    head = message.HEAD
    if not head:
        if not 0 <= sequence <= MAX_SEQUENCE:
            raise MessageError(f"sequence {sequence} is not in 0 to {MAX_SEQUENCE}")
        head = SEQUENCED_HEAD.pack(message.TYPE, sequence)
    try:
        return head + message.LAYOUT.pack(message)
    except ValueError as error:
        raise _message_error(type(message), error) from error


def unpack(payload: bytes) -> tuple[int, Message]:
    """Return the sequence number (0 for stream data and notifications) and the message in a frame's payload.

    Raises MessageError with the sequence number and code that an answer needs.
    """
    if not payload:
        raise MessageError("an empty message")
    message_type, sequence, position = payload[0], NOTIFICATION, 1
    if not FIRST_UNSEQUENCED <= message_type < FIRST_FROM_CONTROLLER:
        position = SEQUENCED_HEAD.size
        if len(payload) < position:
            raise MessageError(f"a message of {len(payload)} bytes, at least {position} are needed")
        sequence = payload[1] | payload[2] << 8
    kind = MESSAGES.get(message_type)
    if kind is None:
        text = f"message type 0x{message_type:02x} is not known to protocol version {PROTOCOL_MAJOR}"
        raise MessageError(text, ErrorCode.UNKNOWN_MESSAGE, sequence)
    try:
        return sequence, kind.LAYOUT.unpack(payload, position)
    except ValueError as error:
        raise _message_error(kind, error, sequence) from error
