"""The controller without any input or output of its own: bytes and time in, bytes and DAC codes out."""

from collections.abc import Callable
from dataclasses import dataclass

from vibrocast import codec
from vibrocast.codec import Decoder
from vibrocast.device_protocol import frames, messages
from vibrocast.device_protocol.coded_stream import IMAGE_HASH_BYTES, StreamError, StreamHeader
from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import (
    NOTIFICATION,
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    ActuatorDescription,
    CaptureData,
    CaptureRead,
    Configure,
    EndStream,
    Error,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashData,
    FlashVerify,
    Gain,
    Hello,
    HelloResponse,
    Limits,
    Loop,
    Message,
    MessageError,
    Pause,
    Position,
    Resume,
    Start,
    State,
    Status,
    StatusRequest,
    Stop,
    StreamData,
)
from vibrocast.output.actuator import PIEZO_STACK, Actuator, Codes
from vibrocast.output.profile import HAND_DELAY_US
from vibrocast.simulated_device.flash import FlashMemory, ImageStore
from vibrocast.simulated_device.playback import Playback
from vibrocast.simulated_device.refusal import Refusal

BUILD = "simulated controller 0.1.0"
FLASH_BYTES = 2056 * 1024  # two sectors of state, two slots of 1 MiB
STATUS_INTERVAL_US = 100_000
MINIMUM_RATE_HZ, MAXIMUM_RATE_HZ = 100, 48_000

# A host that does not read gets no more notifications beyond the first, and no more answers beyond the second.
_UNREAD_NOTIFICATIONS_BYTES = 16 * 1024
_UNREAD_ANSWERS_BYTES = 128 * 1024
# Type, stream, iteration and the packet's length stand before a packet in a frame's payload.
_PACKET_ROOM_BYTES = frames.MAXIMUM_PAYLOAD_BYTES - 12

_ERROR_CHARACTERS = 400

_ACTIVE = (State.ARMED, State.PLAYING, State.PAUSED)


@dataclass(frozen=True)
class Settings:
    """What kind of controller this is.

    `drift_ppm`: how much faster than true time its clock runs. `runtime`: one of codec.RUNTIMES, by which it decodes
    models that leave the choice; None = as the image says. `profile_samples`: of a height profile, of all channels
    together. `position_sensor`: says where the hand is, in nm, at the controller's time, in us; None = the host does.
    """

    actuator: Actuator = PIEZO_STACK
    hardware: str = "simulated"
    drift_ppm: int = 0
    runtime: str | None = None
    channels: int = 8
    buffer_samples: int = 1 << 15
    capture_samples: int = 1 << 19
    watchdog_ms: int = 2000
    profile_samples: int = 1 << 16
    position_sensor: Callable[[int], int] | None = None


class Controller:
    """A tactor controller.

    Call `receive` with what came from the host and `advance` every few milliseconds, both with a clock in microseconds
    that never goes back; send what `transmit` returns. `on_dac` is called with each run of codes int16 (n, channels) as
    they go to the DAC. What the host sends never raises anything; memory does not grow with time or with what comes.
    `flash`: None = a blank one that lasts as long as this object.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        flash: FlashMemory | None = None,
        on_dac: Callable[[Codes], None] | None = None,
    ) -> None:
        self.settings = settings or Settings()
        self._flash = flash or FlashMemory(FLASH_BYTES)
        self._on_dac = on_dac
        self._reader = FrameReader()
        self._outgoing = bytearray()
        self._origin_us: int | None = None
        self._time_us = 0
        self._dac_free_us = 0
        self._boot()

    def _boot(self) -> None:
        self._store = ImageStore(self._flash, self.settings.hardware, codec.check_tables)
        self._playback: Playback | None = None
        self._state_without_stream = State.IDLE
        self._opened_by: int | None = None
        self._last_sequence = 0
        self._last_answer = b""
        self._heard_us = self._time_us
        self._reported: Status | None = None

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self.advance(now_us)
        for payload in self._reader.feed(data):
            self._handle(payload)
        self._notify()

    def advance(self, now_us: int) -> None:
        """Play what is due, and watch over the host."""
        if self._origin_us is None:
            self._origin_us = now_us
        true_us = now_us - self._origin_us
        self._time_us = max(self._time_us, true_us + true_us * self.settings.drift_ppm // 1_000_000)
        if self._playback is None:
            return
        sensor = self.settings.position_sensor
        if sensor is not None and self._playback.state in _ACTIVE:
            self._playback.position(self._time_us, sensor(self._time_us), self._time_us)
        silent_at_us = self._heard_us + self.settings.watchdog_ms * 1000
        if self._playback.state in _ACTIVE and self._time_us > silent_at_us:
            self._put_out(self._playback.advance(silent_at_us))
            if self._playback.state in _ACTIVE:
                self._playback.stop(State.WATCHDOG)
        self._put_out(self._playback.advance(self._time_us))
        self._notify()

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def _put_out(self, codes: Codes) -> None:
        if len(codes) and self._on_dac is not None:
            self._on_dac(codes)

    def _handle(self, payload: bytes) -> None:
        """Act on a message and answer it: docs/protocol.md, "Sequence numbers"."""
        if payload[0] >= HelloResponse.TYPE:
            return
        self._heard_us = self._time_us
        try:
            sequence, message = messages.unpack(payload)
            if sequence == NOTIFICATION and not isinstance(message, StreamData | Position):
                raise MessageError("a request needs a sequence number of 1 or more")
        except MessageError as error:
            refusal = _refuse(error.code, error)
            if error.sequence == NOTIFICATION:
                self._send_notification(refusal)
            elif self._is_new(error.sequence):
                self._answer(error.sequence, refusal)
            return
        if isinstance(message, StreamData):
            if self._playback is not None and message.stream == self._playback.stream:
                self._playback.add(message.iteration, message.packets, self._time_us)
        elif isinstance(message, Position):
            if self._playback is not None and self.settings.position_sensor is None:
                self._playback.position(message.device_time_us, message.position_nm, self._time_us)
        elif isinstance(message, Hello):
            self._greet(sequence, message)
        elif self._opened_by is None and isinstance(message, Stop):
            self._answer(sequence, self._stop())
        elif self._opened_by is None:
            self._answer(sequence, Error(ErrorCode.HELLO_FIRST, "no session is open: say hello first"))
        elif self._is_new(sequence):
            try:
                answer = self._carry_out(message)
            except Refusal as refused:
                answer = _refuse(refused.code, refused)
            except OSError as error:
                answer = _refuse(ErrorCode.FLASH_FAILED, error)
            self._answer(sequence, answer)
            if isinstance(message, FlashActivate) and not isinstance(answer, Error):
                self._stop()
                self._boot()

    def _greet(self, sequence: int, hello: Hello) -> None:
        """Open a session; to copies of the Hello that opened this one, answer again until another request has come."""
        if sequence == self._opened_by:
            if sequence == self._last_sequence:
                self._send_again()
        elif hello.major != PROTOCOL_MAJOR:
            text = (
                f"this controller speaks protocol {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}, the host "
                f"{hello.major}.{hello.minor}: update the older one"
            )
            self._send(sequence, Error(ErrorCode.UNSUPPORTED_VERSION, text))
        else:
            self._opened_by = sequence
            self._answer(sequence, self._describe())

    def _is_new(self, sequence: int) -> bool:
        """Return whether a request is to be carried out; send the kept answer again if it is the last one's copy."""
        if self._opened_by is None:
            return True
        ahead = (sequence - self._last_sequence) % (messages.MAXIMUM_SEQUENCE + 1)
        if ahead == 0:
            self._send_again()
        return 0 < ahead <= messages.MAXIMUM_SEQUENCE // 2

    def _answer(self, sequence: int, answer: Message) -> None:
        """Send an answer and, in a session, keep it."""
        self._send(sequence, answer)
        if self._opened_by is not None:
            self._last_sequence, self._last_answer = sequence, write_frame(messages.pack(answer, sequence))

    def _send(self, sequence: int, message: Message) -> None:
        if len(self._outgoing) < _UNREAD_ANSWERS_BYTES:
            self._outgoing += write_frame(messages.pack(message, sequence))
        if isinstance(message, Status):
            self._reported = message

    def _send_again(self) -> None:
        if len(self._outgoing) < _UNREAD_ANSWERS_BYTES:
            self._outgoing += self._last_answer

    def _send_notification(self, message: Message) -> None:
        if len(self._outgoing) < _UNREAD_NOTIFICATIONS_BYTES:
            self._send(NOTIFICATION, message)

    def _notify(self) -> None:
        """Send a Status where something has happened that the host needs to know, or has not heard for a while."""
        if self._opened_by is None or self._playback is None:
            return
        status, last = self._status(), self._reported
        if (
            last is None
            or status.state != last.state
            or status.underruns > last.underruns
            or status.credit_until - last.credit_until >= self._playback.room_samples // 4
            or (status.state in _ACTIVE[:2] and status.device_time_us - last.device_time_us >= STATUS_INTERVAL_US)
        ):
            self._send_notification(status)

    def _carry_out(self, message: Message) -> Message:
        """Carry out a request other than Hello and return its answer. Raises Refusal, and OSError from the flash."""
        match message:
            case StatusRequest():
                return self._status()
            case Configure():
                return self._configure(message)
            case Start():
                start_us = max(message.device_time_us, self._dac_free_us)
                self._stream_in(State.BUFFERING).start(start_us, self._time_us)
            case Pause():
                self._stream_in(State.PLAYING).pause()
            case Resume():
                self._stream_in(State.PAUSED).resume()
            case Stop():
                return self._stop()
            case Loop():
                self._stream_in(State.BUFFERING, *_ACTIVE).set_loops(message.loops)
            case Gain():
                self._stream_in(State.BUFFERING, *_ACTIVE).set_gain(message.gain)
            case EndStream():
                playback = self._stream_in(State.BUFFERING, *_ACTIVE)
                if not playback.live or message.stream != playback.stream:
                    raise Refusal(ErrorCode.BAD_VALUE, f"stream {message.stream} is not a live stream that plays here")
                playback.end_live(message.packets)
            case CaptureRead():
                return self._capture(message)
            case FlashBegin():
                self._refuse_while_active()
                return self._store.begin(message.slot, message.size_bytes, message.sha256, message.hardware)
            case FlashData():
                return self._store.write(message.slot, message.offset, message.data)
            case FlashVerify():
                return self._store.verify(message.slot)
            case FlashActivate():
                self._refuse_while_active()
                return self._store.activate(message.slot)
            case FlashConfirm():
                return self._store.confirm(message.slot)
            case _:
                raise Refusal(ErrorCode.UNKNOWN_MESSAGE, f"{type(message).__name__} is not for controllers")
        return self._status()

    def _describe(self) -> HelloResponse:
        settings, actuator = self.settings, self.settings.actuator
        lower_hz, upper_hz = actuator.band_hz
        return HelloResponse(
            build=BUILD,
            hardware=settings.hardware,
            limits=Limits(
                maximum_payload_bytes=frames.MAXIMUM_PAYLOAD_BYTES,
                maximum_packet_bytes=_PACKET_ROOM_BYTES,
                buffer_samples=settings.buffer_samples,
                capture_samples=settings.capture_samples,
                channels=settings.channels,
                minimum_rate_hz=MINIMUM_RATE_HZ,
                maximum_rate_hz=MAXIMUM_RATE_HZ,
                watchdog_ms=settings.watchdog_ms,
                profile_samples=settings.profile_samples,
            ),
            actuator=ActuatorDescription(
                name=actuator.name,
                stroke_um=actuator.stroke_um,
                volts=actuator.volts,
                lower_hz=lower_hz,
                upper_hz=upper_hz,
                slew_volts_per_second=actuator.slew_volts_per_second,
                dac_bits=actuator.dac_bits,
                dac_rate_hz=actuator.dac_rate_hz,
            ),
            codecs=tuple((known.identifier, known.name) for known in codec.CODECS.values()),
            images=self._store.describe(),
        )

    def _configure(self, configure: Configure) -> Status:
        settings = self.settings
        try:
            header, used_bytes = StreamHeader.unpack(configure.header)
        except StreamError as error:
            raise Refusal(ErrorCode.BAD_VALUE, f"the stream header cannot be read: {error}") from error
        if used_bytes != len(configure.header):
            raise Refusal(ErrorCode.BAD_VALUE, "there are bytes after the stream header")
        if configure.packets and configure.first_packet >= configure.packets:
            raise Refusal(
                ErrorCode.BAD_VALUE, f"packet {configure.first_packet} of {configure.packets} cannot be the first"
            )
        if header.channels > settings.channels:
            raise Refusal(ErrorCode.BEYOND_LIMITS, f"{header.channels} channels; there are {settings.channels} here")
        if not header.spatial and not MINIMUM_RATE_HZ <= header.rate_hz <= MAXIMUM_RATE_HZ:
            raise Refusal(
                ErrorCode.BEYOND_LIMITS,
                f"a rate of {header.rate_hz} Hz is outside {MINIMUM_RATE_HZ} to {MAXIMUM_RATE_HZ} Hz: resample first",
            )
        playback = Playback(
            configure,
            header,
            self._pick_decoder(header),
            settings.actuator,
            settings.buffer_samples,
            settings.capture_samples,
            settings.profile_samples,
            hand_delay_us=HAND_DELAY_US if settings.position_sensor is None else 0,
        )
        self._stop()
        self._playback = playback
        return self._status()

    def _pick_decoder(self, header: StreamHeader) -> Callable[[], Decoder]:
        """Return the maker of the stream's decoders: here an image chooses its tables and the runtime they need.

        Raises Refusal if the stream needs an image that does not run here.
        """
        tables = None
        if header.image_hash:
            image = self._store.running
            if image is None or self._store.running_sha256[:IMAGE_HASH_BYTES] != header.image_hash:
                raise Refusal(
                    ErrorCode.UNKNOWN_IMAGE,
                    f"the stream needs model image {header.image_hash.hex()}, which does not run here: flash it first",
                )
            if image.codec_identifier != header.codec_identifier:
                raise Refusal(
                    ErrorCode.UNKNOWN_IMAGE,
                    f"model image {header.image_hash.hex()} is for codec {image.codec_identifier}, the stream is of "
                    f"codec {header.codec_identifier}",
                )
            tables = image.payload
        return lambda: codec.decoder(
            header.codec_identifier, header.configuration, header.channels, tables, self.settings.runtime
        )

    def _stream_in(self, *states: State) -> Playback:
        if self._playback is None or self._playback.state not in states:
            wanted = " or ".join(state.name.lower() for state in states)
            raise Refusal(
                ErrorCode.WRONG_STATE, f"the controller is {self._state.name.lower()}; this needs it {wanted}"
            )
        return self._playback

    def _stop(self) -> Status:
        """Ramp down at once: the DAC takes the whole ramp, and is free for another stream when it has played it."""
        self._state_without_stream = State.STOPPED
        if self._playback is not None:
            self._playback.stop(State.STOPPED)
            self._put_out(self._playback.flush(self._time_us))
            self._dac_free_us = max(self._dac_free_us, self._playback.free_us)
        return self._status()

    def _capture(self, read: CaptureRead) -> CaptureData:
        if self._playback is None:
            raise Refusal(ErrorCode.WRONG_STATE, "nothing has been captured yet: configure a stream first")
        channels = self._playback.channels
        empty = CaptureData(read.tap, channels, 0, 0, b"")
        room = (frames.MAXIMUM_PAYLOAD_BYTES - len(messages.pack(empty))) // (2 * channels)
        ring = self._playback.captures[read.tap]
        offset, samples = ring.read(read.offset, min(read.count, room))
        return CaptureData(read.tap, channels, offset, ring.end, samples.astype("<i2").tobytes())

    def _refuse_while_active(self) -> None:
        if self._state in _ACTIVE:
            raise Refusal(ErrorCode.WRONG_STATE, "a stream is being played: stop it first")

    @property
    def _state(self) -> State:
        return self._playback.state if self._playback is not None else self._state_without_stream

    def _status(self) -> Status:
        if self._playback is not None:
            return self._playback.status(self._time_us, self._reader.bad_frames)
        return Status(self._state, 0, self._time_us, 0, 0, 0, self._reader.bad_frames, 0, 0, 0, 0, 0, 0)


def _refuse(code: ErrorCode, reason: Exception) -> Error:
    """Return the Error for a reason, short enough for every frame even if it quotes what the host sent."""
    return Error(code, str(reason)[:_ERROR_CHARACTERS])
