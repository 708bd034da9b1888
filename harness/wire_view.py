"""Follows the frames on a wire, and gives what a page shows: signals, spectra, buffer, losses, state and hints."""

import contextlib
import threading
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec
from vibrocast.codec.stream import shipped_image
from vibrocast.codec.threshold import read_threshold
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader, packet_sequence
from vibrocast.device_protocol.messages import (
    COUNTERS,
    CaptureData,
    Configure,
    Error,
    HelloResponse,
    Message,
    PacketMessage,
    SinglePacket,
    State,
    Status,
    StreamData,
    Tap,
)
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.device_protocol.trace import TracedFrame
from vibrocast.harness.web_server import Page, Refused, Request, json_page
from vibrocast.host.controller import MAX_DAC_RATE_HZ, ControllerError
from vibrocast.host.devices import actuator_model
from vibrocast.host.picture import third_octave_levels
from vibrocast.host.playback import DECODED_FULL_SCALE, displacement_um
from vibrocast.output.actuator import SKIN_OVERSAMPLING, Actuator

Integers = NDArray[np.int16]
KEPT_S = 2.0
"""Of each signal; spectra are of all of it."""
SHOWN_S = 0.1
"""Of each signal, as a waveform."""
HISTORY_S = 60.0
"""Of the buffer."""
FLOOR_DB = -60.0
_MAX_GAP_PACKETS = 64
_PAGE = Path(__file__).with_name("wire_page.html")
_SHOWN_POINTS = 600


class _Signal:
    """The last samples of a signal, int16 (n, channels), from `first` on; `end` counts all of them."""

    def __init__(self, channels: int, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.end = 0
        self.samples: Integers = np.zeros((0, channels), np.int16)

    @property
    def first(self) -> int:
        return self.end - len(self.samples)

    def add(self, samples: Integers) -> None:
        """Take in the samples that follow."""
        self.samples = np.concatenate((self.samples, samples))[-round(KEPT_S * self.rate_hz) :]
        self.end += len(samples)

    def start_at(self, first: int) -> None:
        """Forget all samples; the next one has this number."""
        self.samples, self.end = self.samples[:0], first


class WireView:
    """The content of the frames of one wire. `note` takes them; `answer` serves the page, and its content as JSON."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._began_ns: int | None = None
        self._now_ns = 0
        self._hello: HelloResponse | None = None
        self._actuator: Actuator | None = None
        self._configure: Configure | None = None
        self._header: StreamHeader | None = None
        self._decoder: codec.Decoder | None = None
        self._sent: _Signal | None = None
        self._played: _Signal | None = None
        self._next_packet = 0
        self._status: Status | None = None
        self._buffer_ms: deque[tuple[float, float]] = deque()
        self._note = "no stream has been set up while this page was open"
        self._damaged = {"to the controller": 0, "to the host": 0}
        self._last_error = ""
        self._wrong_samples = 0
        self._threshold = read_threshold()

    def note(self, frames: Iterable[TracedFrame]) -> None:
        """Take in frames, in their order."""
        for frame in frames:
            with self._lock:
                self._note_frame(frame)

    def _note_frame(self, frame: TracedFrame) -> None:
        self._began_ns = frame.time_ns if self._began_ns is None else self._began_ns
        self._now_ns = frame.time_ns
        found = frame.message()
        if found is None:
            self._damaged["to the controller" if frame.from_host else "to the host"] += 1
        else:
            self._take(found[1])

    def _take(self, message: Message) -> None:
        match message:
            case HelloResponse():
                self._hello = message
                with contextlib.suppress(ControllerError):
                    self._actuator = actuator_model(message.actuator)
            case Configure():
                self._begin(message)
            case StreamData() | SinglePacket():
                self._decode(message)
            case CaptureData():
                self._read_back(message)
            case Status():
                self._hear(message)
            case Error():
                self._last_error = message.text

    def _begin(self, message: Configure) -> None:
        """Make ready for a stream."""
        self._configure, self._decoder, self._sent, self._played = message, None, None, None
        self._status = None
        self._next_packet = message.first_packet
        self._wrong_samples = 0
        self._buffer_ms.clear()
        try:
            self._header, _ = StreamHeader.unpack(message.header)
            if self._header.spatial:
                self._note = "a height profile has no waveform until a hand moves over it"
                return
            self._decoder = _decoder(self._header)
        except (codec.CodecError, StreamError) as error:
            self._note = str(error)
            return
        self._note = ""
        self._sent = _Signal(self._header.channels, self._header.rate_hz)
        if self._hello is not None and 0 < self._hello.actuator.dac_rate_hz <= MAX_DAC_RATE_HZ:
            self._played = _Signal(1, self._hello.actuator.dac_rate_hz)

    def _decode(self, message: PacketMessage) -> None:
        """Decode packets as the controller will, with silence for those that the host has left out."""
        if self._decoder is None or self._sent is None or self._configure is None:
            return
        before = message.iteration * self._configure.packets
        for packet in message.packets:
            try:
                number = before + packet_sequence(packet)[0]
                if number < self._next_packet:
                    continue  # sent again
                for _ in range(min(number - self._next_packet, _MAX_GAP_PACKETS)):
                    self._sent.add(self._decoder.conceal())
                self._sent.add(self._decoder.decode(packet))
            except (codec.CodecError, StreamError):
                self._sent.add(self._decoder.conceal())
            self._next_packet = number + 1

    def _read_back(self, message: CaptureData) -> None:
        """Take in samples that the controller has decoded, or codes of its DAC."""
        samples = np.frombuffer(message.data, "<i2").astype(np.int16).reshape(-1, message.channels)
        if message.tap == Tap.DAC and self._played is not None:
            if message.offset + len(samples) <= self._played.end:
                return  # asked for again
            if message.offset != self._played.end:
                self._played.start_at(message.offset)
            self._played.add(samples[:, :1])
        elif message.tap == Tap.DECODED and self._sent is not None and message.channels == self._sent.samples.shape[1]:
            first = max(message.offset, self._sent.first)
            end = min(message.offset + len(samples), self._sent.end)
            if first < end:
                sent = self._sent.samples[first - self._sent.first : end - self._sent.first]
                self._wrong_samples += int(np.sum(sent != samples[first - message.offset : end - message.offset]))

    def _hear(self, status: Status) -> None:
        self._status = status
        if self._header is None or self._header.spatial:
            return
        now_s = self._seconds()
        self._buffer_ms.append((now_s, 1e3 * status.buffered_samples / self._header.rate_hz))
        while self._buffer_ms[0][0] < now_s - HISTORY_S:
            self._buffer_ms.popleft()

    def _seconds(self) -> float:
        return 0.0 if self._began_ns is None else (self._now_ns - self._began_ns) / 1e9

    def answer(self, request: Request) -> Page:
        """Answer a request of the page, from any thread. Raises Refused."""
        if (request.method, request.path) == ("GET", "/"):
            return Page(_PAGE.read_bytes())
        if (request.method, request.path) == ("GET", "/state"):
            return json_page(self.document())
        raise Refused(404, "no such page; open /")

    def document(self) -> dict[str, Any]:
        """Return what the page shows, ready for JSON."""
        with self._lock:
            return self._document()

    def _document(self) -> dict[str, Any]:
        hello, status = self._hello, self._status
        signals = self._displacements()
        return {
            "seconds": self._seconds(),
            "controller": "" if hello is None else f"{hello.hardware}, {hello.build}, actuator {hello.actuator.name}",
            "state": "unknown" if status is None else status.state.name.lower(),
            "codec": self._codec_name(),
            "note": self._note,
            "error": self._last_error,
            "counters": self._counters(),
            "buffer_ms": [list(each) for each in self._buffer_ms],
            "signals": {name: _waveform(values, rate_hz) for name, (values, rate_hz) in signals.items()},
            "spectra": {
                **{name: _spectrum(values, rate_hz) for name, (values, rate_hz) in signals.items()},
                "detection threshold": self._threshold.tolist(),
            },
            "hints": list(self._hints(signals)),
        }

    def _codec_name(self) -> str:
        if self._header is None:
            return ""
        with contextlib.suppress(codec.CodecError):
            return codec.codec_by_identifier(self._header.codec_identifier, self._header.configuration).name
        return f"number {self._header.codec_identifier}"

    def _counters(self) -> dict[str, int]:
        counters = {f"frames damaged {way}": count for way, count in self._damaged.items()}
        if self._status is not None:
            counters |= {name.replace("_", " "): getattr(self._status, name) for name in COUNTERS}
        return {**counters, "samples decoded wrongly": self._wrong_samples}

    def _displacements(self) -> dict[str, tuple[NDArray[np.float64], float]]:
        """Return the displacement, um, that the first channel asks for and that its DAC's codes make, with rates."""
        signals: dict[str, tuple[NDArray[np.float64], float]] = {}
        if self._actuator is None or self._header is None:
            return signals
        if self._sent is not None and len(self._sent.samples):
            values = self._sent.samples[:, :1].astype(np.float64) * (self._header.gains[0] / DECODED_FULL_SCALE)
            signals["sent"] = (
                displacement_um(values, self._header.unit, self._sent.rate_hz, self._actuator)[:, 0],
                self._sent.rate_hz,
            )
        if self._played is not None and len(self._played.samples):
            moved = self._actuator.displacement_um(self._played.samples, SKIN_OVERSAMPLING)[:, 0]
            signals["read back"] = moved, SKIN_OVERSAMPLING * self._played.rate_hz
        return signals

    def _hints(self, signals: dict[str, tuple[NDArray[np.float64], float]]) -> Iterable[str]:
        """Yield what may make an actuator feel wrong, and what to do."""
        status = self._status
        if any(self._damaged.values()) or (status is not None and status.bad_frames):
            yield "Frames are damaged on the wire. Check cable, connectors and baud rate."
        if self._wrong_samples:
            yield "The controller decodes other samples than were sent. Packets were lost, or its decoder is broken."
        if status is not None:
            if status.repeated_frames or status.reordered_frames:
                yield "Frames come twice or out of order. Check what stands between the host and the controller."
            if status.state == State.WATCHDOG:
                yield "The controller heard nothing for too long, and stopped. The host hangs, or the cable is out."
            if status.underruns or status.lost_packets:
                yield "Packets were late or lost, so the output had gaps. Give the host more time: a longer buffer."
            if status.output_gaps:
                yield "The DAC had no sample in time. The controller is too slow for this stream."
            if status.compensation_clipped or status.voltage_limited or status.slew_limited or status.power_limited:
                yield "The signal exceeds what the actuator can do, and is limited, which buzzes. Lower the gain."
        if "read back" not in signals and self._sent is not None:
            yield "Nothing is read back. `vibrocast play` reads back what the DAC gets; `live` does not."


def _decoder(header: StreamHeader) -> codec.Decoder:
    """Return the decoder of a stream; its model must ship. Raises CodecError."""
    image = shipped_image(header)
    if image is None and header.image_hash:
        raise codec.CodecError("the stream needs a model that does not ship, so its waveform is unknown")
    tables = None if image is None else ModelImage.unpack(image).payload
    return codec.decoder(header.codec_identifier, header.configuration, header.channels, tables)


def _waveform(values: NDArray[np.float64], rate_hz: float) -> dict[str, Any]:
    """Return the last SHOWN_S of a signal: seconds before its end, and um."""
    last = values[-round(SHOWN_S * rate_hz) :]
    step = max(1, len(last) // _SHOWN_POINTS)
    times_s = (np.arange(len(last)) - len(last)) / rate_hz
    return {"rms_um": float(np.sqrt(np.mean(last**2))), "points": np.stack((times_s, last), axis=1)[::step].tolist()}


def _spectrum(values: NDArray[np.float64], rate_hz: float) -> list[list[float]]:
    """Return third octaves: Hz, and dB re 1 um peak."""
    frequencies_hz, levels_db = third_octave_levels(values, rate_hz)
    shown = levels_db > FLOOR_DB
    return np.stack((frequencies_hz[shown], levels_db[shown]), axis=1).tolist()  # type: ignore[no-any-return]
