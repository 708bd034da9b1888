"""A controller in this process whose DAC and clock are a sound card's, and the transport to it."""

import contextlib
import math
import select
import socket
import time
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np

from vibrocast.device_protocol.transports import DeviceGone, TransportError
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.output.code_queue import CodeQueue
from vibrocast.output.sound_card import Card, CardUse, Playback
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.real_time import PERIOD_S, RealTimePort

# Codes wait this long for the card, so that a busy computer may make them late.
LEAD_S = 0.02

# The clock follows the card's in this time, and jumps where it is farther off.
_SMOOTHING_S = 0.25
_FAR_PERIODS = 1.5

_READ_BYTES = 65_536
_WRITE_TIMEOUT_S = 1.0
_AT_REST_S = 1.0


class SoundCardPort(RealTimePort):
    """Serves a controller whose DAC is some channels of a card, and is itself the transport to it.

    `channels` count from 1. `actuator` is the one behind the card, whose DAC has 16 bits and the rate at which the card
    is opened. `runtime`: as in simulated_device.controller.Settings. While no stream plays, the card plays silence.
    Raises TransportError, and DeviceGone once the card is gone, MissingExtraError, and ValueError as Controller.
    """

    unsent = b""

    def __init__(self, card: Card, channels: Sequence[int], actuator: Actuator, runtime: str | None = None) -> None:
        queue = CodeQueue(actuator, len(channels))
        settings = Settings(actuator=actuator, hardware="sound card", runtime=runtime, channels=len(channels))
        self._device = _CardController(settings, queue)
        super().__init__(self._device, self._device.now_us)
        self._actuator, self._queue = actuator, queue
        self._playback = Playback(card, channels, queue.take, actuator.dac_rate_hz)
        self._device.playback = self._playback
        # The event loop of the host waits for `file`.
        self.file, self._inner = socket.socketpair()
        self.file.settimeout(_WRITE_TIMEOUT_S)
        self._inner.setblocking(False)
        self._gone: Exception | None = None

    def __enter__(self) -> Self:
        super().__enter__()
        try:
            self._playback.wait_for_begin()
        except BaseException:
            self.close()
            raise
        return self

    @property
    def sound_card(self) -> CardUse:
        """The card that plays, its delay, and how often it had nothing to play."""
        card = self._playback.card
        return CardUse(
            name=card.name,
            backend=card.backend,
            rate_hz=self._playback.rate_hz,
            channels=self._playback.channels,
            full_scale_volts=self._actuator.volts / 2,
            period_ms=1e3 * self._playback.period_s,
            latency_ms=1e3 * (LEAD_S + self._playback.buffer_s),
            underruns=self._queue.underruns + self._playback.underruns,
        )

    # ---- the host's end ----

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises DeviceGone."""
        try:
            self.file.sendall(data)
        except OSError as error:
            raise self._reason() from error

    def read(self, timeout_s: float) -> bytes:
        """Return the available bytes, as soon as there are any; none after `timeout_s`. Raises DeviceGone."""
        readable, _, _ = select.select([self.file], [], [], timeout_s)
        if not readable:
            return b""
        try:
            data = self.file.recv(_READ_BYTES)
        except OSError as error:
            raise self._reason() from error
        if not data:
            raise self._reason()
        return data

    def reopen(self) -> None:
        """Drop what was not read. Raises DeviceGone if the card is gone, because the controller ends with it."""
        if not self._thread.is_alive():
            raise self._reason()
        while self.read(0.0):
            pass

    def _reason(self) -> TransportError:
        if isinstance(self._gone, TransportError):
            return self._gone
        reason = f" ({self._gone!r}); please report it" if self._gone else "; open it again"
        return DeviceGone(f"the controller on the sound card {self._playback.card.name!r} has ended{reason}")

    # ---- the controller's end ----

    def close(self) -> None:
        """Bring the card to rest and release it; may be called again. Raises TransportError if the controller failed.

        A card that is gone is no failure here: reading and writing raise it.
        """
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        if isinstance(self._failure, TransportError):
            self._failure = None
        try:
            super().close()
        finally:
            self._queue.playing = False
            until_s = time.monotonic() + _AT_REST_S
            while not self._queue.at_rest and not self._playback.gone and time.monotonic() < until_s:
                time.sleep(PERIOD_S)
            self._playback.close()
            self.file.close()
            self._inner.close()

    def _run(self) -> None:
        super()._run()
        self._queue.playing = False
        self._gone = self._failure
        # The host reads the end of the connection, and then asks for its reason.
        with contextlib.suppress(OSError):
            self._inner.shutdown(socket.SHUT_RDWR)

    def _wait(self) -> bytes:
        # Bytes that nobody reads wait for the next time.
        with contextlib.suppress(BlockingIOError):
            self._pending = self._pending[self._inner.send(self._pending) :]
        readable, _, _ = select.select([self._inner], [], [], PERIOD_S)
        return self._inner.recv(_READ_BYTES) if readable else b""


class _CardController:
    """The controller, with its clock: that of the card, LEAD_S ahead of the frames that the card has taken.

    Every frame of that time is put into the queue: the controller's codes, and silence while it is at rest. `playback`
    is set before the clock is read.
    """

    def __init__(self, settings: Settings, queue: CodeQueue, monotonic: Callable[[], float] = time.monotonic) -> None:
        self.playback: Playback | None = None
        self._rate_hz = settings.actuator.dac_rate_hz
        self._channels = settings.channels
        self._queue = queue
        self._due = self._made = 0
        self._monotonic = monotonic
        self._read_s = monotonic()
        self._frames = 0.0
        self._playing = False
        self._codes: list[Codes] = []
        self._controller = Controller(settings, on_dac=self._codes.append)

    def now_us(self) -> int:
        """Return the controller's time. Raises DeviceGone if the card is gone, and what its thread has raised."""
        assert self.playback is not None
        self.playback.check()
        self._follow(self.playback)
        self._due = max(self._due, math.floor(self._frames + LEAD_S * self._rate_hz))
        # Rounded up, so that the controller, which rounds down, comes to the same frame.
        return -(-self._due * 1_000_000 // self._rate_hz)

    def _follow(self, playback: Playback) -> None:
        """Move on as this computer's clock does, drawn to the frames that the card has taken, which come in blocks.

        A first-order delay-locked loop; Adriaensen, Using a DLL to filter time, Linux Audio Conference 2005, has one of
        second order. A card that stalls, or jumps by more than its period, takes the clock with it at once.
        """
        now_s = self._monotonic()
        passed_s, self._read_s = now_s - self._read_s, now_s
        measured = self._queue.taken + min(playback.waiting_s, playback.period_s) * self._rate_hz
        self._frames += passed_s * self._rate_hz
        error = measured - self._frames
        far = abs(error) > _FAR_PERIODS * playback.period_s * self._rate_hz
        self._frames += error if far else error * min(1.0, passed_s / _SMOOTHING_S)

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self._controller.receive(data, now_us)
        self._complete()

    def advance(self, now_us: int) -> None:
        """Play the samples that are due, and run the watchdog."""
        self._controller.advance(now_us)
        self._complete()

    def transmit(self) -> bytes:
        """Return the bytes to send to the host, once."""
        return self._controller.transmit()

    def _complete(self) -> None:
        """Put the codes of the controller into the queue, and silence for the time in which it was at rest.

        A stream that began between two frames of the card stays up to one frame behind: that is no silence.
        """
        codes = [self._on_all_channels(each) for each in self._codes]
        self._codes.clear()
        made = sum(map(len, codes))
        missing = self._due - self._made - made
        was_playing = self._playing
        self._playing = missing <= 1 if was_playing else made > 0
        silence = np.zeros((0 if was_playing and self._playing else max(0, missing), self._channels), np.int16)
        for piece in [*codes, silence] if was_playing else [silence, *codes]:
            self._queue.put(piece)
        self._made += made + len(silence)
        self._queue.playing = self._playing

    def _on_all_channels(self, codes: Codes) -> Codes:
        """Return codes of the stream's channels with silence on the others."""
        return np.pad(codes, ((0, 0), (0, self._channels - codes.shape[1])))
