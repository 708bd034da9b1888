"""Live sources: sensors at a serial port or a sound card, the sound of a card, and standard input."""

import contextlib
import io
import math
import queue
import re
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO, Protocol, TypeAlias

import numpy as np
import soundfile
from numpy.typing import NDArray

from vibrocast.codec import SignalFormat
from vibrocast.codec.source import live_format
from vibrocast.device_protocol.coded_stream import MAX_RATE_HZ, StreamError, StreamHeader
from vibrocast.device_protocol.transports import SERIAL_FORM, serial_port
from vibrocast.errors import InputError
from vibrocast.host.player import RECONNECT_S
from vibrocast.host.serial_sensor import Losses, SerialSensor
from vibrocast.textures import INPUT_UNITS, TextureError, sound_files
from vibrocast.textures.recording import MAX_CHANNELS, Signal
from vibrocast.textures.sensitivity import EXAMPLES, Sensitivity

FORMS = f"{SERIAL_FORM} or [audio:]CARD[:CHANNELS]"
"""How inputs are written."""
SOUND_BAND_HZ = (40.0, 800.0)
"""The part of music and speech that is played: what the Pacinian receptors of a finger feel."""

_AUDIO = re.compile(r"(?:audio:)?(?P<card>.+?)(?::(?P<channels>\d+(?:,\d+)*))?")
_BAND_ORDER = 4
# The compressor: above the threshold, 4 dB more in are 1 dB more out. Full scale stays 6 dB below full scale.
_THRESHOLD_DB, _RATIO, _MAKE_UP_DB = -40.0, 4.0, 24.0
_ATTACK_S, _RELEASE_S = 0.005, 0.15
# Of a serial sensor that does not say what it can measure, and the RMS value of a texture: the acceleration and the
# displacement at which most people feel them well at 250 Hz.
_HIGHEST = {"m/s^2": 16 * 9.80665, "um": 1000.0}
_EXPECTED_RMS = {"m/s^2": 1.0, "um": 1.0}
_SILENT = 1e-6  # of full scale, below which the level of a compressor does not fall

# Standard input.
_CHUNK_BYTES = 1 << 16
_CHUNKS = 64  # read ahead of the stream: a source that is no live one waits then
_MAX_HEADER_BYTES = 1 << 20
_BLOCK_S = 0.01
_SAMPLE_BYTES = {"PCM_S8": 1, "PCM_U8": 1, "ULAW": 1, "ALAW": 1, "PCM_16": 2, "PCM_24": 3, "PCM_32": 4, "FLOAT": 4}
_SAMPLE_BYTES["DOUBLE"] = 8
_OTHER_KINDS = {b"FORM": "an AIFF", b"fLaC": "a FLAC", b"OggS": "an Ogg", b"ID3": "an MP3", b"\x89HDF": "an HDF5"}
# Raw samples are multiples of full scale, or of a count. Most other data, read as floats, are beyond these.
_LEAST, _MOST = 1e-20, 1e9
_JUDGED_SAMPLES, _WRONG_PART = 16, 0.25


class Card(Protocol):
    """A sound card that records; as `output.sound_card.Capture`."""

    rate_hz: int
    overruns: int

    def read(self, timeout_s: float) -> NDArray[np.float32]:
        """Return samples (n, channels), where 1.0 is full scale."""


class AnalogueSensor:
    """A sensor whose volts a sound card records; it reads as `SerialSensor` does.

    Lost samples are cut out: how many there were is not known.
    """

    def __init__(self, name: str, card: Card, axes: str, channels: int, sensitivity: Sensitivity, volts: float) -> None:
        self.name, self.rate_hz, self.channels, self.unit = name, card.rate_hz, channels, sensitivity.unit
        self.axes = "".join(sorted(axes))
        self.sensitivity: str | None = sensitivity.text
        self.full_scale: float | None = volts / sensitivity.per_unit
        self.losses = Losses()
        self._columns = [axes.index(axis) for axis in self.axes] if axes else list(range(channels))
        self._card, self._volts = card, volts
        self._frames = 0

    def read(self, timeout_s: float) -> Signal:
        """Return the samples (n, channels) since the last call; none after `timeout_s`. Raises TransportError."""
        samples = self._card.read(timeout_s)
        for _ in range(self._card.overruns - self.losses.gaps):
            self.losses.add(self._frames / self.rate_hz, None)
        self._frames += len(samples)
        return samples[:, self._columns].astype(np.float64) * (self.full_scale or 1.0)

    def introduction(self) -> list[str]:
        """Return lines for people on what came first: none."""
        return []

    def warnings(self) -> list[str]:
        """Return remarks for people: none."""
        return []

    def facts(self) -> dict[str, object]:
        """Return what is known of the card, for the sidecar."""
        return {"volts_full_scale": self._volts}


Source: TypeAlias = SerialSensor | AnalogueSensor


@contextlib.contextmanager
def open_source(
    address: str,
    sensitivity: Sensitivity | None = None,
    volts_full_scale: float | None = None,
    *,
    axes: str = "",
    rate_hz: int | None = None,
    reconnect_s: float = 0.0,
) -> Iterator[Source]:
    """Open the sensor at an address, one of FORMS, and begin to record.

    `sensitivity`: also volts for a sound card, counts for a serial sensor that states no unit. `volts_full_scale`: of a
    sound card, the volts at digital full scale. `axes`: of the channels. `rate_hz`: None = that of the card or sensor.
    `reconnect_s`: of a serial sensor, as there.
    Raises TransportError, TextureError for options that are missing or too many, and MissingExtraError.
    """
    if address.startswith("serial:"):
        if volts_full_scale is not None:
            raise TextureError(
                f"{address} sends numbers",
                action="leave out `volts_full_scale`, which is for a sound card",
                parameter="volts_full_scale",
            )
        port, baud = serial_port(address)
        given = {"rate_hz": rate_hz, "sensitivity": sensitivity, "axes": axes, "reconnect_s": reconnect_s}
        with SerialSensor(port, baud=baud, **given) as sensor:  # type: ignore[arg-type]
            yield sensor
        return
    if sensitivity is None or not sensitivity.in_volts:
        raise TextureError(
            f"{address} records volts",
            action=f"give the sensor's `sensitivity` in volts, such as {EXAMPLES}",
            parameter="sensitivity",
        )
    if volts_full_scale is None:
        raise TextureError(
            f"{address}: how many volts digital full scale is cannot be known",
            action="give `volts_full_scale` (docs/how-to/record.md says how to find it)",
            parameter="volts_full_scale",
        )
    from vibrocast.output import sound_card

    name, channels = _card(address)
    channels = channels or list(range(1, max(1, len(axes)) + 1))
    if axes and len(axes) != len(channels):
        raise TextureError(f"{address}: {len(channels)} channels, and {len(axes)} axes; name the axis of each")
    card = sound_card.find(name, recording=True)
    with sound_card.Capture(card, channels, rate_hz) as capture:
        capture.wait_for_begin()
        yield AnalogueSensor(card.name, capture, axes, len(channels), sensitivity, volts_full_scale)


def _card(address: str) -> tuple[str, list[int]]:
    """Return the name of the card at an address, and the channels that it names. Raises TextureError."""
    match = _AUDIO.fullmatch(address)
    if match is None:
        raise TextureError(f"{address!r} is no input; give {FORMS}")
    return match["card"], [int(number) for number in (match["channels"] or "").split(",") if number]


class SoundInput:
    """Music or speech from a card, as drive signals; it reads as `SerialSensor` does.

    The band SOUND_BAND_HZ passes a compressor, so that quiet sound can be felt and loud sound does not overload the
    actuator. The compressor is feed-forward, with a smooth branching peak detector in dB: D. Giannoulis, M. Massberg,
    J. Reiss, "Digital Dynamic Range Compressor Design", J. Audio Eng. Soc. 60(6), 2012, equations 4 and 16.
    """

    unit, full_scale = "full scale", 1.0

    def __init__(self, name: str, card: Card, channels: int, is_mixed: bool) -> None:
        """`is_mixed`: into one channel. Raises TextureError for a rate that is too low."""
        from scipy import signal

        self.name, self.rate_hz, self.channels = name, card.rate_hz, 1 if is_mixed else channels
        self._card, self._is_mixed = card, is_mixed
        low_hz, high_hz = SOUND_BAND_HZ[0], min(SOUND_BAND_HZ[1], 0.45 * card.rate_hz)
        if low_hz >= high_hz:
            raise TextureError(f"{name}: {card.rate_hz} Hz; give a `rate_hz` of 400 or more", parameter="rate_hz")
        self._band = signal.butter(_BAND_ORDER, (low_hz, high_hz), "bandpass", fs=card.rate_hz, output="sos")
        self._state = np.zeros((len(self._band), 2, self.channels))
        self._attack, self._release = (math.exp(-1 / (each * card.rate_hz)) for each in (_ATTACK_S, _RELEASE_S))
        self._reductions_db = [0.0] * self.channels

    def read(self, timeout_s: float) -> Signal:
        """Return the samples (n, channels) since the last call; none after `timeout_s`. Raises TransportError."""
        from scipy import signal

        samples = self._card.read(timeout_s).astype(np.float64)
        if not len(samples):
            return np.zeros((0, self.channels))
        if self._is_mixed:
            samples = np.mean(samples, axis=1, keepdims=True)
        samples, self._state = signal.sosfilt(self._band, samples, axis=0, zi=self._state)
        levels_db = 20 * np.log10(np.maximum(np.abs(samples), _SILENT))
        wanted_db = np.maximum(0.0, levels_db - _THRESHOLD_DB) * (1 - 1 / _RATIO)
        smoothed_db = np.empty_like(wanted_db)
        for channel, reduction_db in enumerate(self._reductions_db):
            for place, each_db in enumerate(wanted_db[:, channel].tolist()):
                kept = self._attack if each_db > reduction_db else self._release
                reduction_db = kept * reduction_db + (1 - kept) * each_db
                smoothed_db[place, channel] = reduction_db
            self._reductions_db[channel] = reduction_db
        return np.clip(samples * 10 ** ((_MAKE_UP_DB - smoothed_db) / 20), -1.0, 1.0)

    def introduction(self) -> list[str]:
        """Return lines for people on how the sound is played."""
        low_hz, high_hz = SOUND_BAND_HZ
        return [
            f"{self.name}: sound from {low_hz:g} to {high_hz:g} Hz, compressed {_RATIO:g}:1, {self.channels} channel(s)"
        ]


@contextlib.contextmanager
def open_sound(address: str, rate_hz: int) -> Iterator[SoundInput]:
    """Open the sound of the card at an address. Without channels in it, all of the card's are mixed into one.

    Raises TransportError, TextureError and MissingExtraError.
    """
    from vibrocast.output import sound_card

    name, channels = _card(address)
    card = sound_card.find(name, recording=True)
    all_channels = range(1, max(1, card.channels) + 1)
    with sound_card.Capture(card, channels or all_channels, rate_hz) as capture:
        capture.wait_for_begin()
        yield SoundInput(card.name, capture, len(channels), not channels)


@contextlib.contextmanager
def open_live(
    address: str, unit: str | None, full_scale: float | None, rate_hz: int | None, usual_rate_hz: int
) -> Iterator[Source | SoundInput]:
    """Open the live source at an address of FORMS: a sensor or, on a card without a physical unit, sound.

    `unit`: one of INPUT_UNITS, of a sensor that does not state it. `full_scale`: the value in it of digital full scale
    of a card, or of the number 1 of a serial sensor; None = 1. `usual_rate_hz`: of a card, where `rate_hz` is None.
    Raises as `open_source` and `open_sound`.
    """
    is_serial = address.startswith("serial:")
    output_unit, factor = INPUT_UNITS[unit or "drive"]
    if output_unit == "full scale":
        if full_scale is not None or (is_serial and unit is not None):
            raise TextureError(
                f"{address} needs the physical unit of its sensor",
                action="give `unit`, such as g or m/s^2, or leave out `unit` and `full_scale`",
                parameter=("unit", "full_scale"),
            )
        if not is_serial:
            with open_sound(address, rate_hz or usual_rate_hz) as sound:
                yield sound
            return
    one = factor * (full_scale or 1.0)
    sensitivity = Sensitivity(1 / one, output_unit, not is_serial, f"1/({one:g} {output_unit})") if unit else None
    rate_hz = rate_hz if is_serial else rate_hz or usual_rate_hz
    try:
        volts = None if is_serial else 1.0
        with open_source(address, sensitivity, volts, rate_hz=rate_hz, reconnect_s=RECONNECT_S) as sensor:
            yield sensor
    except TextureError as error:
        if "sensitivity" in error.parameter:
            give = "give `unit`, such as g, and as `full_scale` how many of it the number 1 stands for"
            error.action = "leave out `unit` and `full_scale`" if unit else give
            error.parameter = ("unit", "full_scale")
        raise


def skip_kept(source: Source | SoundInput) -> None:
    """Leave out what a source has kept since it was opened: a stream begins with what is taken from now on."""
    while len(source.read(0.0)):
        pass


def format_of(source: "Source | SoundInput | StandardInput") -> SignalFormat:
    """Return the format of a live stream from a source. Raises CodecError."""
    if isinstance(source, SerialSensor):
        return _boundless_format(source, source.full_scale or _HIGHEST[source.unit])
    if isinstance(source, StandardInput) and source.has_no_full_scale:
        return _boundless_format(source, _HIGHEST[source.unit])
    return live_format(source.rate_hz, source.unit, [source.full_scale or 1.0] * source.channels)


def _boundless_format(source: "SerialSensor | StandardInput", highest: float) -> SignalFormat:
    """Return the format of a source whose numbers do not say how large they become."""
    rms = _EXPECTED_RMS[source.unit]
    return live_format(source.rate_hz, source.unit, [highest] * source.channels, [rms] * source.channels)


@dataclass(frozen=True)
class _Header:
    """What a header states. `stated`: unit, full scale and axes of a comment. `data_bytes`: None = not known."""

    kind: str
    rate_hz: int
    channels: int
    subtype: str
    endian: str
    stated: tuple[str, float, str] | None
    data_bytes: int | None


class StandardInput:
    """Samples from standard input, in the unit.

    Without a header they are 32-bit floats, little-endian, with interleaved channels.

    Attributes:
        rate_hz: Samples per second and channel.
        channels: How many there are.
        unit: "full scale", "m/s^2" or "um".
        full_scale: The value of 1.0, in `unit`.
        has_no_full_scale: Whether samples may go beyond 1.0, because they are floats of a physical quantity.
    """

    def __init__(
        self, rate_hz: int | None, channels: int | None, unit: str | None, full_scale: float | None, raw_rate_hz: int
    ) -> None:
        """Wait for the first bytes. `raw_rate_hz`: without a header and a rate. None: a header says it, or a default.

        `unit`: one of INPUT_UNITS. `full_scale`: in it. Raises InputError for files of other kinds, for options that
        are missing or contradict a header, and where nothing comes.
        """
        if sys.stdin is None:
            raise InputError("standard input is closed; pipe samples into it, or name a texture")
        self._received: queue.Queue[bytes] = queue.Queue(_CHUNKS)
        self._pending = b""
        self._ended = False
        # Without the buffer, whose lock the thread would hold when the program ends.
        stream = getattr(sys.stdin.buffer, "raw", sys.stdin.buffer)
        threading.Thread(target=self._receive, args=(stream,), daemon=True).start()
        header = _read_header(self._take, self._put_back)
        if header is None:
            header = _Header("raw", rate_hz or raw_rate_hz, channels or 1, "FLOAT", "LITTLE", None, None)
        for name, given, states in (("rate_hz", rate_hz, header.rate_hz), ("channels", channels, header.channels)):
            if given not in (None, states):
                raise InputError(
                    f"the header on standard input states `{name}` {states}",
                    f"`{name}` is {given}",
                    "leave it out",
                    name,
                )
        if header.channels > MAX_CHANNELS or header.rate_hz > MAX_RATE_HZ:
            raise InputError(
                f"standard input has {header.channels} channels at {header.rate_hz} Hz; give at most {MAX_CHANNELS} at "
                f"{MAX_RATE_HZ} Hz"
            )
        self.rate_hz, self.channels = header.rate_hz, header.channels
        self.unit, self.full_scale = _unit(header, unit, full_scale)
        # Floats of a physical quantity go beyond 1.0, as in the WAV files that vibrocast writes.
        self.has_no_full_scale = full_scale is None and self.unit in _HIGHEST and header.subtype in ("FLOAT", "DOUBLE")
        self._header = header
        self._left_bytes = math.inf if header.data_bytes is None else header.data_bytes
        self._frame_bytes = _SAMPLE_BYTES[header.subtype] * header.channels
        self._block_bytes = max(1, int(_BLOCK_S * header.rate_hz)) * self._frame_bytes
        self._any = False

    def read(self, timeout_s: float) -> Signal | None:
        """Return the samples (n, channels) of at most 10 ms that come next; none after `timeout_s`; None at the end.

        Raises InputError for what can be no samples, and where the input ends before its first sample.
        """
        if len(self._pending) < self._frame_bytes and not self._ended:
            with contextlib.suppress(queue.Empty):
                self._append(self._received.get(timeout=timeout_s))
        whole = int(min(len(self._pending), self._block_bytes, self._left_bytes))
        whole -= whole % self._frame_bytes
        data, self._pending = self._pending[:whole], self._pending[whole:]
        self._left_bytes -= whole
        if not whole and (self._ended or self._left_bytes < self._frame_bytes):
            if not self._any:
                raise InputError("standard input ended before its first sample; check the program that writes to it")
            return None
        self._any |= whole > 0
        samples, _ = soundfile.read(
            io.BytesIO(data),
            dtype="float64",
            always_2d=True,
            samplerate=self.rate_hz,
            channels=self.channels,
            format="RAW",
            subtype=self._header.subtype,
            endian=self._header.endian,
        )
        if self._header.kind == "raw":
            _check_raw(samples, data + self._pending)
        return np.asarray(samples * self.full_scale)

    def _receive(self, stream: BinaryIO) -> None:
        """Hand on what comes, as soon as it is there, in a thread of its own; empty bytes are the end."""
        data = b"first"
        while data:
            data = stream.read(_CHUNK_BYTES)
            self._received.put(data)

    def _append(self, data: bytes) -> None:
        self._pending += data
        self._ended = not data

    def _take(self, count: int) -> bytes:
        """Return the next bytes, as many as there are before the end."""
        while len(self._pending) < count and not self._ended:
            self._append(self._received.get())
        taken, self._pending = self._pending[:count], self._pending[count:]
        return taken

    def _put_back(self, data: bytes) -> None:
        self._pending = data + self._pending


def _unit(header: _Header, unit: str | None, full_scale: float | None) -> tuple[str, float]:
    """Return the unit and the value of 1.0 in it, of a header or a person. Raises InputError."""
    if header.stated is not None:
        if unit is not None or full_scale is not None:
            raise InputError(
                f"standard input states its unit, {header.stated[0]}",
                action="leave out `unit` and `full_scale`",
                parameter=("unit", "full_scale"),
            )
        return header.stated[:2]
    if unit is None:
        raise InputError(
            "standard input does not state its unit",
            action="give `unit`, or drive for a drive signal",
            parameter="unit",
        )
    output_unit, factor = INPUT_UNITS[unit]
    if full_scale is None and output_unit != "full scale" and header.kind != "raw":
        raise InputError(
            f"the {header.kind} file on standard input is relative to full scale",
            action=f"give `full_scale` too, the value of 1.0 in {unit}",
            parameter="full_scale",
        )
    return output_unit, factor * (1.0 if full_scale is None else full_scale)


def _check_raw(samples: Signal, data: bytes) -> None:
    """Raise InputError for numbers that no program writes as samples. `data`: what they were read from."""
    sizes = np.abs(samples[samples != 0])
    wrong = sizes[~((sizes >= _LEAST) & (sizes <= _MOST))]
    are_few = len(sizes) < _JUDGED_SAMPLES or len(wrong) <= _WRONG_PART * len(sizes)
    if are_few and (wrong < _LEAST).all():
        return
    try:
        StreamHeader.unpack(data)
    except StreamError:
        raise InputError(
            f"standard input holds no 32-bit floats: read as such, a sample is {wrong[0]:.3g}".replace("nan", "NaN"),
            action="send float32, little-endian, and neither text nor integers, or put a WAV header before the samples",
        ) from None
    raise InputError("standard input is a coded stream; play it with `vibrocast play FILE`")


def _read_header(take: Callable[[int], bytes], put_back: Callable[[bytes], None]) -> _Header | None:
    """Return the header at which the input begins; None without one. Raises InputError for other kinds of files."""
    magic = take(12)
    put_back(magic)
    if magic[:4] in (b"RIFF", b"RIFX", b"RF64", b"BW64") and magic[8:] == b"WAVE":
        kind, (head, data_bytes) = "WAV", _wav_head(take)
    elif magic[:4] in (b".snd", b"dns."):
        kind, (head, data_bytes) = "AU", _au_head(take)
    elif magic[:4] == b"caff":
        kind, (head, data_bytes) = "CAF", _caf_head(take)
    else:
        for start, other in _OTHER_KINDS.items():
            if magic.startswith(start):
                raise InputError(f"standard input is {other} file; convert it to WAV first")
        return None
    try:
        with soundfile.SoundFile(io.BytesIO(head)) as file:
            endian = file.endian if file.endian != "FILE" else "LITTLE" if kind == "WAV" else "BIG"
            stated = sound_files.stated_by_comment(file.comment)
            header = _Header(kind, file.samplerate, file.channels, file.subtype, endian, stated, data_bytes)
    except soundfile.SoundFileError as error:
        raise InputError(f"the {kind} header on standard input cannot be read ({error}); send plain PCM") from error
    if header.subtype not in _SAMPLE_BYTES:
        raise InputError(f"the {kind} file on standard input holds {header.subtype}; convert it to plain PCM")
    return header


def _taken(take: Callable[[int], bytes], count: int) -> bytes:
    """Return so many bytes of a header. Raises InputError where there are fewer."""
    data = take(count) if count <= _MAX_HEADER_BYTES else b""
    if len(data) < count:
        raise InputError("standard input ends in the header of its file; check the program that writes to it")
    return data


def _wav_head(take: Callable[[int], bytes]) -> tuple[bytes, int | None]:
    """Return the header of a WAV file without its length, and the bytes of its samples, None where not known."""
    riff = _taken(take, 12)
    order = ">" if riff.startswith(b"RIFX") else "<"
    head = (b"RIFX" if order == ">" else b"RIFF") + bytes(4) + b"WAVE"
    long_bytes = None
    while True:
        start = _taken(take, 8)
        name, size = struct.unpack(f"{order}4sI", start)
        if name == b"data":
            break
        body = _taken(take, size + size % 2)
        if name == b"ds64" and size >= 16:  # of RF64: EBU Tech 3306
            (long_bytes,) = struct.unpack_from("<Q", body, 8)
        elif len(head) + len(body) < _MAX_HEADER_BYTES:
            head += start + body
    if long_bytes is None and (size == 0 or sound_files.is_unknown_length(size)):
        return head + b"data" + bytes(4), None
    return head + b"data" + bytes(4), long_bytes or size


def _au_head(take: Callable[[int], bytes]) -> tuple[bytes, int | None]:
    """Return the header of an AU file, and the bytes of its samples, None where not known."""
    start = _taken(take, 12)
    offset, size = struct.unpack(">II" if start.startswith(b".snd") else "<II", start[4:])
    return start + _taken(take, max(24, offset) - 12), None if size >= 2**31 else size


def _caf_head(take: Callable[[int], bytes]) -> tuple[bytes, int | None]:
    """Return the description in a CAF file, and the bytes of its samples, None where not known."""
    head = _taken(take, 8)
    while True:
        start = _taken(take, 12)
        name, size = struct.unpack(">4sq", start)
        if name == b"data":
            _taken(take, 4)  # how often the file was edited
            return head + struct.pack(">4sq", name, 4) + bytes(4), None if size < 0 else size - 4
        if size < 0:
            raise InputError("the CAF header on standard input is damaged; check the program that writes to it")
        body = _taken(take, size)
        if name == b"desc":
            head += start + body
