"""Serial accelerometers: reads their two formats, lines of text or binary frames (docs/reference/serial_sensors.md)."""

import math
import re
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from vibrocast.device_protocol.frames import FrameReader
from vibrocast.device_protocol.transports import BAUD, Closing, SerialTransport, Transport, TransportError
from vibrocast.files import plain
from vibrocast.textures import INPUT_UNITS, TextureError, sidecar
from vibrocast.textures.recording import Signal
from vibrocast.textures.sensitivity import Sensitivity
from vibrocast.textures.text import known_unit

MAX_LINE_BYTES = 200
MAX_CHANNELS = 3
MAX_RATE_HZ = 100_000
MAX_FILLED_S = 1.0
"""Lost samples are interpolated over so much; after a longer gap, a recording ends."""
DESCRIPTION, SAMPLES = 1, 2
"""The first byte of a binary frame: says what it holds."""

_SILENT_S = 5.0  # opening the port restarts some boards, which then need seconds
_UNKNOWN_BYTES = 1 << 16  # of which nothing was understood
_STATED_WITHIN_S = 2.0  # a sensor of text should repeat its comment every second
_LINES = 8  # in a row make it text
_FRAMES = 2  # make it binary
_MEASURED_S = 0.5
_MEASURED_LINES = 32
_MAX_MEASURED_LINES = 20_000
_MAX_BAD_LINES = 200  # in a row
_RATE_TOLERANCE = 0.05  # the clocks of accelerometers are that inaccurate
_GAP_STEPS = 1.5
_WRAP_US = 1 << 32  # of micros() on a board
_MAX_PLACES = 100
_MAX_VALUE = 1e9

_NUMBER = r"[+-]?(?:\d{1,20}\.?\d{0,20}|\.\d{1,20})(?:[eE][+-]?\d{1,2})?"
_LINE = re.compile(rf"\s*(\d{{1,16}})((?:\s*,\s*{_NUMBER}){{1,{MAX_CHANNELS}}})\s*")
_FACT = re.compile(r"(\w+)\s*=\s*(\S+)")


@dataclass(frozen=True)
class Description:
    """The facts that a sensor states of its samples; None = not stated.

    Attributes:
        rate_hz: Samples per second, a whole number.
        unit: One of INPUT_UNITS.
        counts_per_unit: The number that it sends for one `unit`.
        full_scale: The highest value that it can measure, in `unit`.
        axes: One small letter of x, y and z for each channel.
    """

    rate_hz: int | None = None
    unit: str | None = None
    counts_per_unit: float | None = None
    full_scale: float | None = None
    axes: str | None = None

    def with_facts(self, text: str) -> "Description":
        """Return this description with those of a text such as `rate_hz=3200 unit=g axes=xyz`.

        Words without a known name are comments. Raises TransportError for wrong values, and for changed ones.
        """
        given: dict[str, int | float | str] = {}
        known = [each.name for each in fields(self)]
        for name, value in _FACT.findall(text):
            if name in known:
                given[name] = _fact(name, value)
        for name, fact in given.items():
            if getattr(self, name) not in (None, fact):
                raise TransportError(
                    f"the sensor states {name}={getattr(self, name)}, and then {name}={fact}; correct its program"
                )
        return replace(self, **given)  # type: ignore[arg-type]


def _fact(name: str, text: str) -> int | float | str:
    try:
        if name == "unit":
            unit = known_unit(text, "unit")
            if INPUT_UNITS[unit][0] == "full scale":
                raise ValueError
            return unit
        if name == "axes":
            if not sidecar.is_axes("".join(sorted(text))):
                raise ValueError
            return text.lower()
        number = float(text)
        if name == "rate_hz" and (number != int(number) or number > MAX_RATE_HZ):
            raise ValueError
        if not 1 / _MAX_VALUE < number < _MAX_VALUE:
            raise ValueError
    except (ValueError, OverflowError):
        raise TransportError(
            f"the sensor states {name}={plain(text[:40])}, which cannot be; correct its program"
        ) from None
    return int(number) if name == "rate_hz" else number


@dataclass
class Losses:
    """Lost samples of a recording. `places`: start in s and number of samples, None = unknown; only the first ones."""

    gaps: int = 0
    samples: int = 0
    places: list[tuple[float, int | None]] = field(default_factory=list)

    def add(self, at_s: float, samples: int | None) -> None:
        """Note a gap."""
        self.gaps += 1
        self.samples += samples or 0
        if len(self.places) < _MAX_PLACES:
            self.places.append((round(at_s, 4), samples))


class Lines:
    """Finds samples in lines `time_us,x,y,z`; holds at most one line, whatever arrives.

    `is_text`: whether some lines in a row were samples; `channels` is fixed then. `bad`: lines that were neither
    samples nor comments, without the first line. `bad_in_a_row`: how many of these have come since the last sample.
    """

    def __init__(self) -> None:
        self.description = Description()
        self.is_text = False
        self.bad = self.bad_in_a_row = self._good_in_a_row = 0
        self.channels = 0
        self._pending = bytearray()
        self._whole = False  # the first line may have begun before the port was open

    def feed(self, data: bytes) -> list[tuple[int, tuple[float, ...]]]:
        """Take bytes that arrived; return the times in us and values of the lines that they complete.

        Raises TransportError for a comment that states wrong facts.
        """
        samples = []
        *closed, rest = data.split(b"\n")
        for piece in closed:
            self._keep(piece)
            line, whole = bytes(self._pending), self._whole
            self._pending.clear()
            self._whole = True
            if (whole or line.startswith(b"#")) and (sample := self._sample(line)):
                samples.append(sample)
        self._keep(rest)
        return samples

    def _keep(self, piece: bytes) -> None:
        # Keep one byte more than the longest line, as a mark that the line is too long.
        self._pending += piece[: MAX_LINE_BYTES + 1 - len(self._pending)]

    def _sample(self, line: bytes) -> tuple[int, tuple[float, ...]] | None:
        text = line.decode("ascii", "replace").strip()
        if not text:
            return None
        if text.startswith("#") and len(line) <= MAX_LINE_BYTES:
            self.description = self.description.with_facts(text)
            return None
        match = _LINE.fullmatch(text) if len(line) <= MAX_LINE_BYTES else None
        values = tuple(map(float, match[2].split(",")[1:])) if match else ()
        if not self.is_text:
            self.channels = len(values)
        if match is None or len(values) != self.channels or max(map(abs, values)) > _MAX_VALUE:
            self.bad += 1
            self.bad_in_a_row += 1
            self._good_in_a_row = 0
            return None
        self._good_in_a_row += 1
        self.is_text |= self._good_in_a_row >= _LINES
        self.bad_in_a_row = 0
        return int(match[1]), values


class Frames:
    """Finds samples in binary frames; holds at most one frame, whatever arrives. `bad`: frames that were damaged."""

    def __init__(self) -> None:
        self.description = Description()
        self.found = 0
        self._reader = FrameReader()
        self._wrong = 0

    @property
    def bad(self) -> int:
        """How many frames were damaged, or of a wrong length."""
        return self._reader.bad_frames + self._wrong

    def feed(self, data: bytes) -> list[tuple[int, Signal]]:
        """Take bytes that arrived; return the number of the first sample and the samples (n, channels) of each frame.

        Frames before a description with axes are left out. Raises TransportError for a description with wrong facts.
        """
        pieces = []
        for payload in self._reader.feed(data):
            kind, content = payload[0], payload[1:]
            if kind == DESCRIPTION:
                self.description = self.description.with_facts(content.decode("ascii", "replace"))
            elif kind == SAMPLES:
                self.found += 1
                width = 2 * len(self.description.axes or "")
                if not width:
                    continue
                if len(content) <= 4 or (len(content) - 4) % width:
                    self._wrong += 1
                    continue
                (number,) = struct.unpack_from("<I", content)
                pieces.append((number, np.frombuffer(content[4:], "<i2").reshape(-1, width // 2).astype(np.float64)))
            else:
                self._wrong += 1
        return pieces


class NumberedSamples:
    """Puts samples of binary frames, whose numbers count them, on a uniform grid.

    A gap is interpolated from its two ends. `losses`: the samples that were lost.
    """

    def __init__(self, frames: Frames, rate_hz: int) -> None:
        self.losses = Losses()
        self._frames, self._rate_hz = frames, rate_hz
        self._expected: int | None = None
        self._last = np.zeros(0)
        self._placed = 0
        self._bad_before = frames.bad

    def feed(self, data: bytes) -> Signal:
        """Take bytes that arrived; return the samples (n, channels) that are now known. Raises TransportError."""
        return self.place(self._frames.feed(data))

    def place(self, pieces: list[tuple[int, Signal]]) -> Signal:
        """Return the samples of frames in a row, those of gaps between them filled in. Raises TransportError."""
        placed = [np.zeros((0, len(self._frames.description.axes or "")))]
        for number, samples in pieces:
            missing = 0 if self._expected is None else (number - self._expected) % 2**32
            if missing > MAX_FILLED_S * self._rate_hz:
                raise TransportError(
                    f"the sensor's count of samples jumps from {self._expected} to {number}, which is more than "
                    f"{MAX_FILLED_S:g} s; check its cable and that it does not restart"
                )
            if missing:
                self.losses.add(self._placed / self._rate_hz, missing)
                part = np.arange(1, missing + 1)[:, None] / (missing + 1)
                placed.append(self._last + part * (samples[0] - self._last))
            placed.append(samples)
            self._placed += missing + len(samples)
            self._expected = (number + len(samples)) % 2**32
            self._last = samples[-1]
        return np.concatenate(placed)

    def warnings(self) -> list[str]:
        """Return remarks on the stream, for people."""
        damaged = self._frames.bad - self._bad_before
        return [f"{damaged} damaged frame(s)"] if damaged else []


class TimedSamples:
    """Puts samples of lines on a uniform grid, interpolated from their times. `losses`: the samples that were lost.

    Between samples by the cubic polynomial with the parabolic slope at either end (C. de Boor, A Practical Guide to
    Splines, 1978, chapter IV: Bessel interpolation), over gaps by a line.
    """

    def __init__(self, lines: Lines, rate_hz: int, period_us: float) -> None:
        self.losses = Losses()
        self.worst_jitter_us = 0.0
        self._lines, self._rate_hz, self._period_us = lines, rate_hz, period_us
        self._times_us = np.zeros(0)  # since the first sample; the last ones, whose surroundings are not all known
        self._samples = np.zeros((0, lines.channels))
        self._first_us: int | None = None
        self._last_us = 0
        self._placed = 0
        self._late = self._all_late = 0
        self._squares = 0.0
        self._steps = 0
        self._bad_before = lines.bad
        self._slowest_hz = self._fastest_hz = 1e6 / period_us
        self._second: list[float] = []

    def feed(self, data: bytes) -> Signal:
        """Take bytes that arrived; return the samples (n, channels) that are now known. Raises TransportError."""
        found = self._lines.feed(data)
        if self._lines.bad_in_a_row > _MAX_BAD_LINES:
            raise TransportError(
                f"the sensor has sent {self._lines.bad_in_a_row} lines in a row that hold no sample; check its "
                "program, its cable and the @BAUD of its address"
            )
        return self.place(found)

    def place(self, found: list[tuple[int, tuple[float, ...]]]) -> Signal:
        """Return the samples on the grid that further lines determine. Raises TransportError."""
        times_us, samples = [], []
        for time_us, values in found:
            if self._first_us is None:
                self._first_us = self._last_us = time_us
            else:
                step_us = time_us - self._last_us
                if step_us < -_WRAP_US // 2 and self._last_us < _WRAP_US:
                    self._first_us -= _WRAP_US
                    step_us += _WRAP_US
                if step_us > 1e6 * MAX_FILLED_S:
                    raise TransportError(
                        f"the sensor's time jumps by {step_us / 1e6:g} s; check its cable and that it does not restart"
                    )
                if step_us <= 0:
                    self._late += 1
                    self._all_late += 1
                    if self._late > _MAX_BAD_LINES:
                        raise TransportError(
                            "the sensor's time runs back; check that it does not restart, and that its time is in us"
                        )
                    continue
                self._late = 0
                self._note_step(step_us, time_us - self._first_us)
                self._last_us = time_us
            times_us.append(float(time_us - self._first_us))
            samples.append(values)
        if not samples:
            return self._samples[:0]
        self._times_us = np.concatenate((self._times_us, times_us))
        self._samples = np.concatenate((self._samples, np.asarray(samples, np.float64)))
        if len(self._times_us) < 4:
            return self._samples[:0]
        return self._interpolated()

    def _note_step(self, step_us: int, now_us: int) -> None:
        steps = step_us / self._period_us
        if steps > _GAP_STEPS:
            self.losses.add((now_us - step_us) / 1e6, max(1, round(steps) - 1))
            return
        jitter_us = abs(step_us - self._period_us)
        self.worst_jitter_us = max(self.worst_jitter_us, jitter_us)
        self._squares += jitter_us**2
        self._steps += 1
        self._second.append(step_us)
        if len(self._second) >= self._rate_hz:
            # Slow drift of the sensor's clock is no jitter.
            rate_hz = 1e6 * len(self._second) / sum(self._second)
            self._slowest_hz, self._fastest_hz = min(self._slowest_hz, rate_hz), max(self._fastest_hz, rate_hz)
            self._period_us = 1e6 / rate_hz
            self._second.clear()

    def _interpolated(self) -> Signal:
        """Return the grid up to the last but one sample, whose slope is known, and forget what it needs no more."""
        t, x = self._times_us, self._samples
        step_us = 1e6 / self._rate_hz
        end = math.floor(t[-2] / step_us) + 1
        grid_us = step_us * np.arange(self._placed, max(end, self._placed))
        h = np.diff(t)[:, None]
        secants = np.diff(x, axis=0) / h
        slopes = np.concatenate(
            (secants[:1], (h[1:] * secants[:-1] + h[:-1] * secants[1:]) / (h[1:] + h[:-1]), secants[-1:])
        )
        at = np.clip(np.searchsorted(t, grid_us, side="right") - 1, 0, len(h) - 1)
        part = (grid_us - t[at])[:, None] / h[at]
        slope_before, slope_after = slopes[at], slopes[at + 1]
        gap = h[at] > _GAP_STEPS * self._period_us
        slope_before, slope_after = np.where(gap, secants[at], slope_before), np.where(gap, secants[at], slope_after)
        # The cubic Hermite polynomial of both values and slopes.
        result: Signal = (
            (1 + 2 * part) * (1 - part) ** 2 * x[at]
            + part**2 * (3 - 2 * part) * x[at + 1]
            + h[at] * part * (1 - part) * ((1 - part) * slope_before - part * slope_after)
        )
        self._placed = max(end, self._placed)
        keep = max(0, int(np.searchsorted(t, step_us * self._placed, side="right")) - 2)
        self._times_us, self._samples = t[keep:], x[keep:]
        return result

    def warnings(self) -> list[str]:
        """Return remarks on the stream, for people."""
        remarks = []
        if damaged := self._lines.bad - self._bad_before:
            remarks.append(f"{damaged} line(s) without a sample")
        if self._all_late:
            remarks.append(f"{self._all_late} line(s) whose time did not rise")
        if self._fastest_hz > (1 + _RATE_TOLERANCE) * self._slowest_hz:
            remarks.append(f"the sensor's rate changed between {self._slowest_hz:.1f} and {self._fastest_hz:.1f} Hz")
        return remarks

    @property
    def jitter_us(self) -> float:
        """The RMS deviation of the steps in time from their mean, without gaps."""
        return math.sqrt(self._squares / max(1, self._steps))


class SerialSensor(Closing):
    """A serial sensor that sends samples.

    `rate_hz`, `sensitivity` and `axes`: needed where the sensor does not state them. `axes` may also choose some of
    those that it states. Raises TransportError, and TextureError for options that are missing or contradict the sensor.

    Attributes:
        rate_hz: Of the samples that `read` returns.
        unit: "m/s^2" or "um".
        axes: One letter for each channel, or none.
        channels: How many there are.
        full_scale: The highest value that the sensor can measure, in `unit`; None = unknown.
        description: What the sensor states.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = BAUD,
        rate_hz: int | None = None,
        sensitivity: Sensitivity | None = None,
        axes: str = "",
        open_port: Callable[[str, int], Transport] = SerialTransport,
    ) -> None:
        self.name = f"serial:{port}"
        self.sensitivity = None if sensitivity is None else sensitivity.text
        self._transport = open_port(port, baud)
        try:
            self._heard_s = time.monotonic()
            reader = self._recognised()
            self.description = reader.description
            self.format = "text" if isinstance(reader, Lines) else "binary"
            self._scale, self.unit = self._scaled(sensitivity)
            self._columns, self.axes = self._chosen(axes, reader)
            self.channels = len(self._columns)
            limit = self.description.full_scale
            if limit is not None and self.description.unit is not None:
                self.full_scale: float | None = limit * INPUT_UNITS[self.description.unit][1]
            else:
                # int16 ends at 32767; what ends a number in text is not known.
                self.full_scale = 32767 * self._scale if self.format == "binary" else None
            self._placing, self._first = self._placed(reader, rate_hz)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the port; may be called again."""
        self._transport.close()

    @property
    def losses(self) -> Losses:
        """The samples that were lost on the way, which `read` has interpolated."""
        return self._placing.losses

    def warnings(self) -> list[str]:
        """Return remarks on the stream so far, for people."""
        return self._placing.warnings()

    def facts(self) -> dict[str, object]:
        """Return what is known of the stream, for the sidecar."""
        facts: dict[str, object] = {"format": self.format}
        if isinstance(self._placing, TimedSamples):
            facts |= {
                "jitter_us": round(self._placing.jitter_us, 2),
                "worst_jitter_us": round(self._placing.worst_jitter_us, 2),
            }
        return facts

    def read(self, timeout_s: float) -> Signal:
        """Return the samples (n, channels) since the last call; none after `timeout_s`.

        Raises TransportError if the port breaks off, and if the sensor sends no samples any more.
        """
        first, self._first = self._first, self._first[:0]
        if len(first):
            return self._finished(first)
        return self._finished(self._placing.feed(self._bytes(timeout_s)))

    def _finished(self, samples: Signal) -> Signal:
        return samples[:, self._columns] * self._scale

    def _bytes(self, timeout_s: float) -> bytes:
        data = self._transport.read(timeout_s)
        now_s = time.monotonic()
        if data:
            self._heard_s = now_s
        elif now_s - self._heard_s > _SILENT_S:
            raise TransportError(f"{self.name} sends nothing; check that the sensor runs, and that this is its port")
        return data

    def _recognised(self) -> Lines | Frames:
        """Read until the format is known, and return its reader, which knows the description."""
        lines, frames = Lines(), Frames()
        received = 0
        began_s = time.monotonic()
        known_s: float | None = None
        while True:
            data = self._bytes(0.1)
            received += len(data)
            lines.feed(data)
            frames.feed(data)
            if lines.is_text:
                known_s = known_s or time.monotonic()
                if lines.description != Description() or time.monotonic() - known_s >= _STATED_WITHIN_S:
                    return lines
                continue
            if frames.found >= _FRAMES and frames.description.axes:
                return frames
            if received > _UNKNOWN_BYTES or (received and time.monotonic() - began_s > 2 * _SILENT_S):
                problem = (
                    "sends samples in frames, and no frame that states its axes; let it send one every second"
                    if frames.found >= _FRAMES
                    else "sends neither lines of samples nor frames; check the @BAUD of its address, and that this is "
                    "the sensor's port"
                )
                raise TransportError(f"{self.name} {problem}")

    def _scaled(self, sensitivity: Sensitivity | None) -> tuple[float, str]:
        """Return the value of one count, and its unit. Raises TextureError."""
        stated = self.description
        if stated.unit is not None:
            if sensitivity is not None:
                raise TextureError(
                    f"{self.name} states its unit, {stated.unit}; leave out `sensitivity`", parameter="sensitivity"
                )
            unit, factor = INPUT_UNITS[stated.unit]
            return factor / (stated.counts_per_unit or 1.0), unit
        if sensitivity is None:
            raise TextureError(
                f"{self.name} does not state its unit",
                action="give `sensitivity`, such as 256/g where 256 is one g",
                parameter="sensitivity",
            )
        if sensitivity.in_volts:
            raise TextureError(
                f"{self.name} sends numbers, not volts",
                action="give `sensitivity` in counts, such as 256/g where 256 is one g",
                parameter="sensitivity",
            )
        return 1 / sensitivity.per_unit, sensitivity.unit

    def _chosen(self, axes: str, reader: Lines | Frames) -> tuple[list[int], str]:
        """Return the columns to record, in the order x, y, z, and their axes. Raises TextureError."""
        width = reader.channels if isinstance(reader, Lines) else len(reader.description.axes or "")
        stated = self.description.axes or (axes if axes else "xyz" if width == MAX_CHANNELS else "")
        if stated and len(stated) != width:
            raise TextureError(
                f"{self.name} sends {width} channels, and {len(stated)} axes are named",
                f"`axes`={stated}",
                parameter="axes",
            )
        if missing := [axis for axis in axes if axis not in stated]:
            raise TextureError(
                f"{self.name} has the axes {stated}", action=f"leave {missing[0]} out of `axes`", parameter="axes"
            )
        chosen = "".join(sorted(axes or stated))
        return ([stated.index(axis) for axis in chosen] if chosen else list(range(width))), chosen

    def _placed(self, reader: Lines | Frames, rate_hz: int | None) -> tuple[NumberedSamples | TimedSamples, Signal]:
        """Return what places the samples, and the first ones. Raises TextureError and TransportError."""
        stated_hz = self.description.rate_hz
        if rate_hz is not None and stated_hz not in (None, rate_hz):
            raise TextureError(
                f"{self.name} states {stated_hz} Hz", action=f"leave out `rate_hz`={rate_hz}", parameter="rate_hz"
            )
        wanted_hz = rate_hz or stated_hz
        if isinstance(reader, Frames):
            if wanted_hz is None:
                raise TextureError(
                    f"{self.name} does not state its sample rate", action="give `rate_hz`", parameter="rate_hz"
                )
            self.rate_hz = wanted_hz
            numbered = NumberedSamples(reader, wanted_hz)
            return numbered, np.zeros((0, len(reader.description.axes or "")))
        found: list[tuple[int, tuple[float, ...]]] = []
        while len(found) < _MEASURED_LINES or found[-1][0] - found[0][0] < 1e6 * _MEASURED_S:
            if reader.bad_in_a_row > _MAX_BAD_LINES or len(found) > _MAX_MEASURED_LINES:
                raise TransportError(
                    f"{self.name}: its times do not rise in us, or its lines change; correct its program"
                )
            found += reader.feed(self._bytes(0.1))
        steps_us = np.diff([float(time_us) for time_us, _ in found])
        median_us = float(np.median(steps_us))
        if not median_us >= 1e6 / MAX_RATE_HZ:
            raise TransportError(f"{self.name}: its times do not rise in us; correct its program")
        period_us = float(np.mean(steps_us[(steps_us > 0) & (steps_us <= _GAP_STEPS * median_us)]))
        measured_hz = 1e6 / period_us
        if wanted_hz is not None and abs(measured_hz - wanted_hz) > _RATE_TOLERANCE * wanted_hz:
            raise TransportError(
                f"{self.name} gives its rate as {wanted_hz} Hz, and its times say {measured_hz:.1f} Hz; correct one of "
                "them, or raise the @BAUD of its address if it loses lines"
            )
        self.rate_hz = wanted_hz or max(1, round(measured_hz))
        timed = TimedSamples(reader, self.rate_hz, period_us)
        return timed, timed.place(found)
