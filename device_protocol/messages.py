"""Messages between host and controller: one frozen dataclass each, with its bytes (docs/protocol.md has the tables)."""

import math
import struct
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from enum import IntEnum
from typing import Any, ClassVar, Self, TypeVar

from vibrocast.device_protocol.encoding import pack_varint, unpack_varint

PROTOCOL_MAJOR = 1
PROTOCOL_MINOR = 1

# A sequence number of 0 marks what nobody asked for: a notification.
NOTIFICATION = 0
MAXIMUM_SEQUENCE = 0xFFFF

_UNSEQUENCED_TYPES = range(0x40, 0x80)
_SEQUENCE = struct.Struct("<BH")
_TLV = struct.Struct("<BH")
_VARINT_BITS = 32
_Member = TypeVar("_Member", bound=IntEnum)


class ErrorCode(IntEnum):
    """Why a controller refused a request."""

    UNKNOWN_MESSAGE = 1
    MALFORMED = 2
    UNSUPPORTED_VERSION = 3
    HELLO_FIRST = 4
    WRONG_STATE = 5
    BAD_VALUE = 6
    UNKNOWN_CODEC = 7
    UNKNOWN_IMAGE = 8
    BEYOND_LIMITS = 9
    NO_SUCH_SLOT = 10
    WRONG_HARDWARE = 11
    IMAGE_REFUSED = 12
    FLASH_FAILED = 13


class MessageError(ValueError):
    """A message that cannot be packed, or bytes that are no message.

    `sequence` is the sequence number to answer with (0: none could be read, or the type takes no answer) and `code`
    the ErrorCode to answer.
    """

    def __init__(self, text: str, code: ErrorCode = ErrorCode.MALFORMED) -> None:
        super().__init__(text)
        self.sequence = NOTIFICATION
        self.code = code


class State(IntEnum):
    """What the controller is doing with its stream."""

    IDLE = 0
    BUFFERING = 1
    ARMED = 2
    PLAYING = 3
    PAUSED = 4
    FINISHED = 5
    STOPPED = 6
    WATCHDOG = 7
    FAULT = 8


class Tap(IntEnum):
    """Where a capture is taken: samples as decoded (stream rate), or codes as given to the DAC (DAC rate)."""

    DECODED = 0
    DAC = 1


class SlotState(IntEnum):
    """What a slot for model images holds."""

    EMPTY = 0
    WRITING = 1
    VERIFIED = 2
    TRIAL = 3
    CONFIRMED = 4


class Message:
    """A message with a fixed part, whose fields are the dataclass's own, and then TLVs that a reader may skip."""

    TYPE: ClassVar[int]
    FIXED: ClassVar[struct.Struct] = struct.Struct("<")

    def body(self) -> bytes:
        """Return the bytes after the header. Raises MessageError for a value out of its field's range."""
        return _pack(self.FIXED, *astuple(self))  # type: ignore[call-overload]

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError."""
        values, rest = _unpack(cls.FIXED, body)
        for _ in _tlvs(rest):
            pass  # no tag is known here; only their lengths are checked
        return cls(*values)


# ---- from the host: requests ----


@dataclass(frozen=True)
class Hello(Message):
    """Opens a session; the protocol version that the host speaks. Its layout is the same in every version."""

    TYPE = 0x01
    FIXED = struct.Struct("<BB")

    major: int = PROTOCOL_MAJOR
    minor: int = PROTOCOL_MINOR


@dataclass(frozen=True)
class StatusRequest(Message):
    """Asks for a Status; also keeps the watchdog content."""

    TYPE = 0x02


@dataclass(frozen=True)
class Configure(Message):
    """Sets up a stream; whatever played before is stopped first.

    `stream`: 0-255, chosen by the host, marks this stream's data. `packets`: packets in one iteration, 0 = unknown
    (live). `first_packet`: the refresh packet that playing begins with. `loops`: iterations, 0 = until stopped.
    `gain`: factor on the signal. `header`: the bytes of `coded_stream.StreamHeader`.
    """

    TYPE = 0x03
    FIXED = struct.Struct("<BBIIIHf")
    COMPENSATION: ClassVar[int] = 0x01
    HEADER_TAG: ClassVar[int] = 0x01

    stream: int
    header: bytes
    prebuffer_samples: int
    packets: int = 0
    first_packet: int = 0
    loops: int = 1
    compensation: bool = True
    gain: float = 1.0

    def __post_init__(self) -> None:
        _check_gain(self.gain)

    def body(self) -> bytes:
        """Return the bytes after the header."""
        flags = self.COMPENSATION if self.compensation else 0
        counts = (self.prebuffer_samples, self.packets, self.first_packet, self.loops)
        return _pack(self.FIXED, self.stream, flags, *counts, self.gain) + _tlv(self.HEADER_TAG, self.header)

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError, also for a flag that is not known."""
        (stream, flags, prebuffer_samples, packets, first_packet, loops, gain), rest = _unpack(cls.FIXED, body)
        if flags & ~cls.COMPENSATION:
            text = f"flags 0x{flags:02x} are asked for, only 0x{cls.COMPENSATION:02x} is known"
            raise MessageError(text, ErrorCode.BAD_VALUE)
        header = dict(_tlvs(rest)).get(cls.HEADER_TAG)
        if header is None:
            raise MessageError("the stream header is missing")
        return cls(stream, header, prebuffer_samples, packets, first_packet, loops, bool(flags), gain)


@dataclass(frozen=True)
class Start(Message):
    """Starts the configured stream at a device time; 0 or a time gone by = as soon as the prebuffer is there."""

    TYPE = 0x04
    FIXED = struct.Struct("<Q")

    device_time_us: int = 0


@dataclass(frozen=True)
class Pause(Message):
    """Fades out and holds the position."""

    TYPE = 0x05


@dataclass(frozen=True)
class Resume(Message):
    """Fades in where Pause held."""

    TYPE = 0x06


@dataclass(frozen=True)
class Stop(Message):
    """Ramps down at once and drops the stream; valid in every state, before a hello as well."""

    TYPE = 0x07


@dataclass(frozen=True)
class Loop(Message):
    """Sets the iterations of the stream, those already played counted; 0 = until stopped."""

    TYPE = 0x08
    FIXED = struct.Struct("<H")

    loops: int


@dataclass(frozen=True)
class Gain(Message):
    """Moves the gain to a new factor, along a ramp."""

    TYPE = 0x09
    FIXED = struct.Struct("<f")

    gain: float

    def __post_init__(self) -> None:
        _check_gain(self.gain)


@dataclass(frozen=True)
class EndStream(Message):
    """States where a live stream ends: the number of its packets. Tells the end from an underrun."""

    TYPE = 0x0A
    FIXED = struct.Struct("<BI")

    stream: int
    packets: int


@dataclass(frozen=True)
class CaptureRead(Message):
    """Asks for `count` captured samples per channel, from `offset` samples after the start of the stream."""

    TYPE = 0x0B
    FIXED = struct.Struct("<BQH")

    tap: Tap
    offset: int
    count: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "tap", _member(Tap, self.tap))


@dataclass(frozen=True)
class FlashBegin(Message):
    """Announces a model image for a slot; the same image as before goes on where it was cut."""

    TYPE = 0x10
    FIXED = struct.Struct("<BI32s")
    HARDWARE_TAG: ClassVar[int] = 0x01

    slot: int
    size_bytes: int
    sha256: bytes
    hardware: str

    def __post_init__(self) -> None:
        _check_sha256(self.sha256)

    def body(self) -> bytes:
        """Return the bytes after the header."""
        return _pack(self.FIXED, self.slot, self.size_bytes, self.sha256) + _tlv(
            self.HARDWARE_TAG, self.hardware.encode()
        )

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError."""
        (slot, size_bytes, sha256), rest = _unpack(cls.FIXED, body)
        hardware = dict(_tlvs(rest)).get(cls.HARDWARE_TAG)
        if hardware is None:
            raise MessageError("the hardware is missing")
        return cls(slot, size_bytes, sha256, _text(hardware))


@dataclass(frozen=True)
class FlashData(Message):
    """A piece of the image; data is the rest of the message."""

    TYPE = 0x11
    FIXED = struct.Struct("<BI")

    slot: int
    offset: int
    data: bytes

    def body(self) -> bytes:
        """Return the bytes after the header."""
        return _pack(self.FIXED, self.slot, self.offset) + self.data

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError."""
        (slot, offset), data = _unpack(cls.FIXED, body)
        return cls(slot, offset, data)


@dataclass(frozen=True)
class FlashVerify(Message):
    """Asks the controller to read the slot back, hash it and compare."""

    TYPE = 0x12
    FIXED = struct.Struct("<B")

    slot: int


@dataclass(frozen=True)
class FlashActivate(Message):
    """Restarts the controller with a verified slot on trial: unless confirmed, the next restart falls back."""

    TYPE = 0x13
    FIXED = struct.Struct("<B")

    slot: int


@dataclass(frozen=True)
class FlashConfirm(Message):
    """Keeps the slot that is on trial."""

    TYPE = 0x14
    FIXED = struct.Struct("<B")

    slot: int


# ---- from the host: stream data, never answered ----


@dataclass(frozen=True)
class StreamData(Message):
    """Packets of a stream, each as `coded_stream.packet_sequence` reads it; `iteration` counts loops from 0."""

    TYPE = 0x40

    stream: int
    iteration: int
    packets: tuple[bytes, ...]

    def body(self) -> bytes:
        """Return the bytes after the type."""
        if not 0 <= self.stream <= 0xFF:
            raise MessageError(f"stream {self.stream} is not in 0 to 255")
        if not 0 <= self.iteration < 1 << _VARINT_BITS:
            raise MessageError(f"iteration {self.iteration} is not in 0 to 2^{_VARINT_BITS} - 1")
        pieces = [bytes([self.stream]), pack_varint(self.iteration)]
        for packet in self.packets:
            pieces += [pack_varint(len(packet)), packet]
        return b"".join(pieces)

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError."""
        if not body:
            raise MessageError("the stream is missing")
        iteration, position = _unpack_varint(body, 1)
        packets = []
        while position < len(body):
            length, position = _unpack_varint(body, position)
            if length > len(body) - position:
                raise MessageError(f"a packet of {length} bytes, {len(body) - position} are left")
            packets.append(body[position : position + length])
            position += length
        return cls(body[0], iteration, tuple(packets))


@dataclass(frozen=True)
class Position(Message):
    """Where the hand was at a device time (0 = when the message comes), from any origin; for all channels."""

    TYPE = 0x41
    FIXED = struct.Struct("<Qq")

    device_time_us: int
    position_nm: int


# ---- from the controller: responses, and notifications of the same layout ----


@dataclass(frozen=True)
class Limits:
    """What the controller can take. `watchdog_ms`: longest silence of the host while armed, playing or paused.

    `profile_samples`: of a height profile, of all channels together; 0, or left out by protocol 1.0: none.
    """

    FIXED: ClassVar[struct.Struct] = struct.Struct("<HHIIBIIH")
    PROFILE: ClassVar[struct.Struct] = struct.Struct("<I")

    maximum_payload_bytes: int
    maximum_packet_bytes: int
    buffer_samples: int
    capture_samples: int
    channels: int
    minimum_rate_hz: int
    maximum_rate_hz: int
    watchdog_ms: int
    profile_samples: int = 0

    def value(self) -> bytes:
        """Return the bytes of the TLV. Raises MessageError."""
        *fixed, profile_samples = astuple(self)
        return _pack(self.FIXED, *fixed) + _pack(self.PROFILE, profile_samples)

    @classmethod
    def from_value(cls, value: bytes) -> Self:
        """Return the limits in a TLV. Raises MessageError."""
        fixed, rest = _unpack(cls.FIXED, value)
        profile = _unpack(cls.PROFILE, rest)[0] if len(rest) >= cls.PROFILE.size else ()
        return cls(*fixed, *profile)


@dataclass(frozen=True)
class ActuatorDescription:
    """What the controller drives.

    `stroke_um`: full displacement at `volts`. `lower_hz`, `upper_hz`: -3 dB, lower 0 = down to rest.
    `slew_volts_per_second`: 0 = not limited.
    """

    FIXED: ClassVar[struct.Struct] = struct.Struct("<fffffBI")

    name: str
    stroke_um: float
    volts: float
    lower_hz: float
    upper_hz: float
    slew_volts_per_second: float
    dac_bits: int
    dac_rate_hz: int


@dataclass(frozen=True)
class ImageDescription:
    """A slot and the model image in it; `sha256` is of the whole image."""

    FIXED: ClassVar[struct.Struct] = struct.Struct("<BB32sB")

    slot: int
    state: SlotState
    sha256: bytes = bytes(32)
    name: str = ""
    version: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "state", _member(SlotState, self.state))
        _check_sha256(self.sha256)


@dataclass(frozen=True)
class HelloResponse(Message):
    """The controller's version, limits, actuator, codecs (identifier, name) and model images."""

    TYPE = 0x80
    FIXED = struct.Struct("<BB")
    BUILD_TAG: ClassVar[int] = 0x01
    HARDWARE_TAG: ClassVar[int] = 0x02
    LIMITS_TAG: ClassVar[int] = 0x03
    ACTUATOR_TAG: ClassVar[int] = 0x04
    CODEC_TAG: ClassVar[int] = 0x05
    IMAGE_TAG: ClassVar[int] = 0x06

    build: str
    hardware: str
    limits: Limits
    actuator: ActuatorDescription
    codecs: tuple[tuple[int, str], ...]
    images: tuple[ImageDescription, ...] = ()
    major: int = PROTOCOL_MAJOR
    minor: int = PROTOCOL_MINOR

    def body(self) -> bytes:
        """Return the bytes after the header."""
        name, *numbers = astuple(self.actuator)
        pieces = [
            _pack(self.FIXED, self.major, self.minor),
            _tlv(self.BUILD_TAG, self.build.encode()),
            _tlv(self.HARDWARE_TAG, self.hardware.encode()),
            _tlv(self.LIMITS_TAG, self.limits.value()),
            _tlv(self.ACTUATOR_TAG, _pack(ActuatorDescription.FIXED, *numbers) + name.encode()),
        ]
        for identifier, codec_name in self.codecs:
            pieces.append(_tlv(self.CODEC_TAG, _pack(struct.Struct("<B"), identifier) + codec_name.encode()))
        for image in self.images:
            image_name = image.name.encode()
            fixed = _pack(ImageDescription.FIXED, image.slot, image.state, image.sha256, len(image_name))
            pieces.append(_tlv(self.IMAGE_TAG, fixed + image_name + image.version.encode()))
        return b"".join(pieces)

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError, also if a tag that must be there is missing."""
        (major, minor), rest = _unpack(cls.FIXED, body)
        tlvs = list(_tlvs(rest))
        single = dict(tlvs)
        for tag in (cls.BUILD_TAG, cls.HARDWARE_TAG, cls.LIMITS_TAG, cls.ACTUATOR_TAG):
            if tag not in single:
                raise MessageError(f"tag {tag} is missing")
        numbers, name = _unpack(ActuatorDescription.FIXED, single[cls.ACTUATOR_TAG])
        codecs = [_unpack(struct.Struct("<B"), value) for tag, value in tlvs if tag == cls.CODEC_TAG]
        return cls(
            build=_text(single[cls.BUILD_TAG]),
            hardware=_text(single[cls.HARDWARE_TAG]),
            limits=Limits.from_value(single[cls.LIMITS_TAG]),
            actuator=ActuatorDescription(_text(name), *numbers),
            codecs=tuple((identifier, _text(codec_name)) for (identifier,), codec_name in codecs),
            images=tuple(_image(value) for tag, value in tlvs if tag == cls.IMAGE_TAG),
            major=major,
            minor=minor,
        )


@dataclass(frozen=True)
class Status(Message):
    """What the controller is doing: the response to most requests, and the notification that grants credit.

    Positions and credit count samples of the stream, per channel, over all iterations. `credit_until`: data that ends
    at or before this position may be sent. `buffered_samples`: received and not yet played. The last five are counts
    since Configure, `bad_frames` since the controller started.
    """

    TYPE = 0x81
    FIXED = struct.Struct("<BBQQQIIIIIIII")

    state: State
    stream: int
    device_time_us: int
    position: int
    credit_until: int
    buffered_samples: int
    bad_frames: int
    underruns: int
    lost_packets: int
    compensation_clipped: int
    voltage_limited: int
    slew_limited: int
    power_limited: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "state", _member(State, self.state))


@dataclass(frozen=True)
class CaptureData(Message):
    """Captured samples, int16 little-endian, channels interleaved, as the rest of the message.

    `offset` is the first sample's (later than asked if the controller no longer has that one), `end` the number
    captured since the stream started.
    """

    TYPE = 0x82
    FIXED = struct.Struct("<BBQQ")

    tap: Tap
    channels: int
    offset: int
    end: int
    data: bytes

    def __post_init__(self) -> None:
        object.__setattr__(self, "tap", _member(Tap, self.tap))
        if self.channels < 1 or len(self.data) % (2 * self.channels):
            raise MessageError(f"{len(self.data)} bytes are no int16 samples of {self.channels} channels")

    def body(self) -> bytes:
        """Return the bytes after the header."""
        return _pack(self.FIXED, self.tap, self.channels, self.offset, self.end) + self.data

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError."""
        (tap, channels, offset, end), data = _unpack(cls.FIXED, body)
        return cls(tap, channels, offset, end, data)


@dataclass(frozen=True)
class FlashStatus(Message):
    """Answers every flash request: what the slot holds, the offset that data must go on from, and, once it has been
    read back, the SHA-256 of it (zeros before)."""

    TYPE = 0x83
    FIXED = struct.Struct("<BBI32s")

    slot: int
    state: SlotState
    next_offset: int
    sha256: bytes = bytes(32)

    def __post_init__(self) -> None:
        object.__setattr__(self, "state", _member(SlotState, self.state))
        _check_sha256(self.sha256)


@dataclass(frozen=True)
class Error(Message):
    """A refusal: an ErrorCode (or a later one) and text for a person. Its layout is the same in every version."""

    TYPE = 0xFF
    FIXED = struct.Struct("<H")
    TEXT_TAG: ClassVar[int] = 0x01

    code: int
    text: str

    def body(self) -> bytes:
        """Return the bytes after the header."""
        return _pack(self.FIXED, self.code) + _tlv(self.TEXT_TAG, self.text.encode())

    @classmethod
    def from_body(cls, body: bytes) -> Self:
        """Return the message that `body` packed. Raises MessageError."""
        (code,), rest = _unpack(cls.FIXED, body)
        return cls(code, _text(dict(_tlvs(rest)).get(cls.TEXT_TAG, b"")))


REQUESTS: tuple[type[Message], ...] = (
    Hello,
    StatusRequest,
    Configure,
    Start,
    Pause,
    Resume,
    Stop,
    Loop,
    Gain,
    EndStream,
    CaptureRead,
    FlashBegin,
    FlashData,
    FlashVerify,
    FlashActivate,
    FlashConfirm,
)
RESPONSES: tuple[type[Message], ...] = (HelloResponse, Status, CaptureData, FlashStatus, Error)

ALL: tuple[type[Message], ...] = (*REQUESTS, StreamData, Position, *RESPONSES)
MESSAGES = {message.TYPE: message for message in ALL}


def pack(message: Message, sequence: int = NOTIFICATION) -> bytes:
    """Return a message as the payload of a frame. Stream data carries no sequence number.

    Raises MessageError for a value out of its field's range.
    """
    if message.TYPE in _UNSEQUENCED_TYPES:
        return bytes([message.TYPE]) + message.body()
    if not 0 <= sequence <= MAXIMUM_SEQUENCE:
        raise MessageError(f"sequence {sequence} is not in 0 to {MAXIMUM_SEQUENCE}")
    return _SEQUENCE.pack(message.TYPE, sequence) + message.body()


def unpack(payload: bytes) -> tuple[int, Message]:
    """Return the sequence number (0 for stream data and notifications) and the message in a frame's payload.

    Raises MessageError with the sequence number and code that an answer needs.
    """
    sequence = NOTIFICATION
    try:
        if not payload:
            raise MessageError("an empty message")
        message_type, body = payload[0], payload[1:]
        if message_type not in _UNSEQUENCED_TYPES:
            if len(payload) < _SEQUENCE.size:
                raise MessageError(f"a message of {len(payload)} bytes, at least {_SEQUENCE.size} are needed")
            _, sequence = _SEQUENCE.unpack_from(payload)
            body = payload[_SEQUENCE.size :]
        if message_type not in MESSAGES:
            text = f"message type 0x{message_type:02x} is not known to protocol version {PROTOCOL_MAJOR}"
            raise MessageError(text, ErrorCode.UNKNOWN_MESSAGE)
        message = MESSAGES[message_type]
        try:
            return sequence, message.from_body(body)
        except MessageError as error:
            raise MessageError(f"{message.__name__}: {error}", error.code) from error
    except MessageError as error:
        error.sequence = sequence
        raise


def _tlv(tag: int, value: bytes) -> bytes:
    return _pack(_TLV, tag, len(value)) + value


def _tlvs(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (tag, value) of each TLV. Raises MessageError where a length does not fit."""
    position = 0
    while position < len(data):
        if len(data) - position < _TLV.size:
            raise MessageError(f"{len(data) - position} bytes are left, too few for a tag and its length")
        tag, length = _TLV.unpack_from(data, position)
        position += _TLV.size
        if length > len(data) - position:
            raise MessageError(f"tag {tag} has {length} bytes, {len(data) - position} are left")
        yield tag, data[position : position + length]
        position += length


def _unpack_varint(data: bytes, position: int) -> tuple[int, int]:
    """Return the value and the position after it. Raises MessageError if it is cut or longer than 32 bits."""
    try:
        return unpack_varint(data, position, _VARINT_BITS)
    except ValueError as error:
        raise MessageError(str(error)) from error


def _pack(layout: struct.Struct, *values: object) -> bytes:
    try:
        return layout.pack(*values)
    except (struct.error, OverflowError) as error:
        raise MessageError(str(error)) from error


def _unpack(layout: struct.Struct, data: bytes) -> tuple[tuple[Any, ...], bytes]:
    """Return the values of a fixed part and the bytes after it. Raises MessageError if the fixed part is cut."""
    if len(data) < layout.size:
        raise MessageError(f"{len(data)} bytes, at least {layout.size} are needed")
    return layout.unpack_from(data), data[layout.size :]


def _image(value: bytes) -> ImageDescription:
    (slot, state, sha256, name_bytes), texts = _unpack(ImageDescription.FIXED, value)
    if name_bytes > len(texts):
        raise MessageError(f"an image's name of {name_bytes} bytes, {len(texts)} are left")
    return ImageDescription(slot, state, sha256, _text(texts[:name_bytes]), _text(texts[name_bytes:]))


def _text(data: bytes) -> str:
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise MessageError("text that is not UTF-8") from error


def _member(enumeration: type[_Member], value: int) -> _Member:
    try:
        return enumeration(value)
    except ValueError as error:
        raise MessageError(f"{value} is no {enumeration.__name__}", ErrorCode.BAD_VALUE) from error


def _check_gain(gain: float) -> None:
    if not (math.isfinite(gain) and gain >= 0):
        raise MessageError(f"a gain of {gain} is not a finite factor of at least 0", ErrorCode.BAD_VALUE)


def _check_sha256(sha256: bytes) -> None:
    if len(sha256) != 32:
        raise MessageError(f"a SHA-256 has 32 bytes, not {len(sha256)}")
