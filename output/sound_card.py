"""Sound cards by miniaudio: finds them, plays DAC codes on them and records from them."""

import contextlib
import math
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import extras
from vibrocast.device_protocol.transports import Closing, DeviceGone, TransportError
from vibrocast.output.actuator import Codes

DEFAULT = "default"
"""The name of the card that the system uses by default."""

# A card that states no rate resamples by itself; every card knows this one.
_USUAL_RATE_HZ = 48_000
PERIOD_S = 0.01
_PLAYBACK_PERIODS = 3
# More than in playback, where each period delays: a computer under load may read late.
_CAPTURE_PERIODS = 20
# A sound server may take this long to begin, and then asks once a period.
_FIRST_S = 5.0
_FIRST_BLOCKS = 8
_LOST_S = 1.0
# The monitor of a card that is idle may bring samples every two seconds, and a busy computer passes them on late.
_LOST_RECORDING_S = 5.0
# ALSA's name of its device without a card.
_NO_CARD = "Discard all samples"
# In each window, some block comes on time; clocks of cards differ by less than this in it.
_WINDOW_S = 0.25
_SKIP_S = 0.003
# Of a recording that nobody reads, this much is kept.
_UNREAD_S = 10.0


@dataclass(frozen=True)
class Card:
    """A sound card, or a device of a sound server, for playback or for recording.

    Attributes:
        name: As the system names it, with a number behind it where another one has the same.
        channels: How many it has; 0 = as many as are asked for.
        rate_hz: The sample rate at which it works.
        default: Whether the system uses it by default.
        backend: The interface of the system, such as PulseAudio or WASAPI.
        identifier: How miniaudio names it.
    """

    name: str
    channels: int
    rate_hz: int
    default: bool
    backend: str
    identifier: Any = field(repr=False, compare=False)


@dataclass(frozen=True)
class CardUse:
    """How a card plays: the card, the actuator's volts at digital full scale, and how late and how well it plays.

    `latency_ms`: from the controller to the card's output, without the card's own delay. `underruns`: how often
    the card had nothing to play since it was opened.
    """

    name: str
    backend: str
    rate_hz: int
    channels: tuple[int, ...]
    full_scale_volts: float
    period_ms: float
    latency_ms: float
    underruns: int


def cards(recording: bool = False) -> list[Card]:
    """Return the cards of this computer that play, or those that record. Raises MissingExtraError."""
    miniaudio = _miniaudio()
    try:
        context, backend = _context(miniaudio)
    except TransportError:
        return []
    try:
        return _listed(miniaudio, context, backend, recording)
    finally:
        miniaudio.lib.ma_context_uninit(context)


def find(name: str, recording: bool = False) -> Card:
    """Return the card of this name, of which a unique part in any case of letters is enough.

    DEFAULT is the system's default card. Raises TransportError, which lists the cards, and MissingExtraError.
    """
    found = cards(recording)
    kind = "recording" if recording else "playback"
    if not found:
        raise TransportError(
            f"there is no sound card for {kind}; connect one, and check that the sound server runs (on Linux, "
            "PulseAudio or PipeWire)"
        )
    wanted = name.casefold()
    if wanted == DEFAULT:
        chosen = [card for card in found if card.default] or found[:1]
    else:
        chosen = [card for card in found if card.name.casefold() == wanted]
        chosen = chosen or [card for card in found if wanted in card.name.casefold()]
    if len(chosen) == 1:
        return chosen[0]
    names = ", ".join(repr(card.name) for card in (chosen or found))
    if chosen:
        raise TransportError(f"{len(chosen)} sound cards for {kind} match {name!r}: {names}; give more of the name")
    raise TransportError(f"no sound card for {kind} matches {name!r}; there are {names}")


class _Stream(Closing):
    """The common part of playback and capture: the open card, its end, and the errors that say why it ended."""

    def __init__(self, card: Card, channels: Sequence[int], rate_hz: int | None, periods: int, lost_s: float) -> None:
        self.card = card
        self.channels = _checked_channels(card, channels)
        self.rate_hz = rate_hz or card.rate_hz
        self.period_s = PERIOD_S
        self.buffer_s = PERIOD_S * periods
        self._width = card.channels or max(self.channels)
        self._columns = [channel - 1 for channel in self.channels]
        self._failure: Exception | None = None
        self._stopped = False
        self._blocks_done = self._frames = 0
        self._window_s = 0.0
        self._behind_s = self._least_s = math.inf
        self._last_s: float | None = None
        self._started_s = time.monotonic()
        self._device: Any = None
        self._periods = periods
        self._lost_s = lost_s

    def _start(self, kind: str, sample_format: str, work: Generator[Any, Any, None]) -> None:
        miniaudio = _miniaudio()
        next(work)
        try:
            self._device = getattr(miniaudio, kind)(
                getattr(miniaudio.SampleFormat, sample_format),
                self._width,
                self.rate_hz,
                round(1000 * PERIOD_S),
                self.card.identifier,
                self._periods,
                _backends(miniaudio),
                app_name="vibrocast",
            )
            self._device.stop_callback = self._note_stop
            self._device.start(work)
        except miniaudio.MiniaudioError as error:
            self.close()
            raise TransportError(
                f"the sound card {self.card.name!r} cannot be opened ({error}); check that it is connected, and that "
                "no other program has it alone"
            ) from error

    def _note_stop(self) -> None:
        self._stopped = True

    def _note_block(self, frames: int) -> bool:
        """Note that the card asks for frames, or brings them; return whether it has skipped.

        The system states no skips. But the card falls behind this computer's clock then, and stays behind.
        """
        self._last_s = now_s = time.monotonic()
        self._blocks_done += 1
        if self._blocks_done <= _FIRST_BLOCKS:
            self._window_s, self._least_s = now_s, math.inf
            return False
        self._frames += frames
        self._least_s = min(self._least_s, now_s - self._frames / self.rate_hz)
        if now_s - self._window_s < _WINDOW_S:
            return False
        behind_s, self._behind_s = self._least_s - self._behind_s, self._least_s
        self._window_s, self._least_s = now_s, math.inf
        return behind_s > _SKIP_S

    @property
    def waiting_s(self) -> float:
        """How long ago the card asked for the last time; 0 before the first."""
        return 0.0 if self._last_s is None else time.monotonic() - self._last_s

    @property
    def gone(self) -> bool:
        """Whether the card takes or brings samples no more."""
        silent_s = time.monotonic() - (self._last_s or self._started_s)
        return self._stopped or silent_s > (self._lost_s if self._blocks_done >= _FIRST_BLOCKS else _FIRST_S)

    def wait_for_begin(self) -> None:
        """Wait until the card asks regularly. Raises TransportError after some seconds, as `check`."""
        while self._blocks_done < _FIRST_BLOCKS:
            self.check()
            time.sleep(PERIOD_S / 2)

    def check(self) -> None:
        """Raise DeviceGone if the card is gone, and whatever the function that passes samples on has raised."""
        if self._failure is not None:
            raise self._failure
        if self._device is None:
            raise DeviceGone(f"the sound card {self.card.name!r} is closed; open it again")
        if self.gone:
            raise DeviceGone(
                f"the sound card {self.card.name!r} is gone; it was unplugged or its sound server ended; connect it, "
                "and start again"
            )

    def close(self) -> None:
        """Release the card; may be called again."""
        device, self._device = self._device, None
        if device is not None:
            context = device._context
            device.stop_callback = None
            device.close()
            # miniaudio's own close leaves the connection to the sound server open.
            _miniaudio().lib.ma_context_uninit(context)


class Playback(_Stream):
    """Plays codes on some channels of a card, and silence on the others, until it is closed.

    `fill` is called with a number of frames from another thread, once a period, and returns codes int16 (frames,
    channels) without waiting. `channels` count from 1. `rate_hz`: None = that of the card. `underruns`: how
    often the card had nothing to play, as far as its clock tells. Raises TransportError and MissingExtraError.
    """

    def __init__(
        self, card: Card, channels: Sequence[int], fill: Callable[[int], Codes], rate_hz: int | None = None
    ) -> None:
        super().__init__(card, channels, rate_hz, _PLAYBACK_PERIODS, _LOST_S)
        self._fill = fill
        self.underruns = 0
        self._start("PlaybackDevice", "SIGNED16", self._played())

    def _played(self) -> Generator[Codes | bytes, int, None]:
        frames = yield b""
        while True:
            self.underruns += self._note_block(frames)
            codes = np.zeros((frames, self._width), np.int16)
            if self._failure is None:
                try:
                    codes[:, self._columns] = self._fill(frames)
                except Exception as failure:  # no exception may reach the thread of the card: `check` raises it
                    self._failure = failure
            frames = yield codes

    def close(self) -> None:
        """Release the card after it has played all that it has taken; may be called again."""
        if self._device is not None and not self.gone:
            time.sleep(self.buffer_s + self.period_s)  # closing throws away what is still in the buffer
        super().close()


class Capture(_Stream):
    """Records some channels of a card until it is closed.

    `channels` count from 1. `rate_hz`: None = that of the card; the system resamples to any other. `overruns`: how
    often samples were lost, because the computer or the reader was too slow. Raises TransportError and
    MissingExtraError.
    """

    def __init__(self, card: Card, channels: Sequence[int], rate_hz: int | None = None) -> None:
        super().__init__(card, channels, rate_hz, _CAPTURE_PERIODS, _LOST_RECORDING_S)
        self.overruns = 0
        self._blocks: deque[bytes] = deque(maxlen=round(_UNREAD_S / PERIOD_S))
        self._arrived = threading.Event()
        self._start("CaptureDevice", "FLOAT32", self._recorded())

    def _recorded(self) -> Generator[None, bytearray, None]:
        while True:
            block = yield
            full = len(self._blocks) == self._blocks.maxlen
            self.overruns += self._note_block(len(block) // (4 * self._width)) or full
            self._blocks.append(bytes(block))
            self._arrived.set()

    def read(self, timeout_s: float) -> NDArray[np.float32]:
        """Return the samples float32 (n, channels) since the last call, where 1.0 is full scale.

        Waits until there are any, and returns none after `timeout_s`. Raises TransportError if the card is gone.
        """
        if not self._blocks:
            self._arrived.clear()
            self._arrived.wait(timeout_s)
        blocks = []
        with contextlib.suppress(IndexError):
            while True:
                blocks.append(self._blocks.popleft())
        if not blocks:
            self.check()
        samples = np.frombuffer(b"".join(blocks), np.float32).reshape(-1, self._width)
        return np.ascontiguousarray(samples[:, self._columns])


def _checked_channels(card: Card, channels: Sequence[int]) -> tuple[int, ...]:
    if not channels or min(channels) < 1 or len(set(channels)) < len(channels):
        raise TransportError(f"channels {list(channels)}; give different ones, counted from 1")
    if card.channels and max(channels) > card.channels:
        raise TransportError(
            f"the sound card {card.name!r} has {card.channels} channels, and channel {max(channels)} was asked for; "
            "choose others, or a profile of the card with more channels in the settings of the system"
        )
    return tuple(channels)


def _miniaudio() -> Any:
    extras.require("audio", "miniaudio")
    import miniaudio

    return miniaudio


def _backends(miniaudio: Any) -> list[Any]:
    """Return the interfaces that lead to a card, in the order in which miniaudio prefers them."""
    names = {"win32": ["WASAPI"], "darwin": ["COREAUDIO"]}.get(sys.platform, ["PULSEAUDIO"])
    # Without a card, ALSA complains on stderr.
    if Path("/dev/snd").exists():
        names.append("ALSA")
    return [miniaudio.Backend[name] for name in names]


def _context(miniaudio: Any) -> tuple[Any, str]:
    """Return the first context that works, and the name of its interface. Raises TransportError."""
    ffi, lib = miniaudio.ffi, miniaudio.lib
    backends = ffi.new("ma_backend[]", [backend.value for backend in _backends(miniaudio)])
    context = ffi.new("ma_context *")
    if lib.ma_context_init(backends, len(backends), ffi.NULL, context) != lib.MA_SUCCESS:
        raise TransportError("this system has no interface to sound cards; install PulseAudio, PipeWire or ALSA")
    return context, _text(ffi, lib.ma_get_backend_name(context.backend))


def _listed(miniaudio: Any, context: Any, backend: str, recording: bool) -> list[Card]:
    ffi, lib = miniaudio.ffi, miniaudio.lib
    infos, count = ffi.new("ma_device_info **"), ffi.new("ma_uint32 *")
    none = ffi.NULL, ffi.NULL
    wanted = (infos, count)
    if lib.ma_context_get_devices(context, *(none + wanted if recording else wanted + none)) != lib.MA_SUCCESS:
        return []
    kind = lib.ma_device_type_capture if recording else lib.ma_device_type_playback
    found = []
    names: Counter[str] = Counter()
    for info in infos[0][0 : count[0]]:
        # A card that was unplugged meanwhile is none.
        if lib.ma_context_get_device_info(context, kind, ffi.addressof(info.id), ffi.addressof(info)) == lib.MA_SUCCESS:
            formats = info.nativeDataFormats[0 : info.nativeDataFormatCount]
            channels = max((each.channels for each in formats), default=0)
            rates_hz = [each.sampleRate for each in formats if each.channels == channels and each.sampleRate]
            rate_hz = _USUAL_RATE_HZ if _USUAL_RATE_HZ in rates_hz or not rates_hz else max(rates_hz)
            identifier = ffi.new("ma_device_id *", info.id)
            name = _text(ffi, info.name)
            if name.startswith(_NO_CARD):
                continue
            names[name] += 1
            name = name if names[name] == 1 else f"{name} ({names[name]})"
            found.append(Card(name, channels, rate_hz, bool(info.isDefault), backend, identifier))
    return found


def _text(ffi: Any, characters: Any) -> str:
    return str(ffi.string(characters).decode(errors="replace"))
