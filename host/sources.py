"""Live sources behind an address: sensors at a serial port or a sound card, and the sound of a card."""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec import SignalFormat
from vibrocast.codec.source import live_format
from vibrocast.device_protocol.transports import SERIAL_FORM, serial_port
from vibrocast.host.player import RECONNECT_S
from vibrocast.host.serial_sensor import Losses, SerialSensor
from vibrocast.textures import INPUT_UNITS, TextureError
from vibrocast.textures.recording import Signal
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


@contextmanager
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


@contextmanager
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


@contextmanager
def open_live(
    address: str, unit: str | None, full_scale: float | None, rate_hz: int | None, usual_rate_hz: int
) -> Iterator[SerialSensor | AnalogueSensor | SoundInput]:
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


def skip_kept(source: SerialSensor | AnalogueSensor | SoundInput) -> None:
    """Leave out what a source has kept since it was opened: a stream begins with what is taken from now on."""
    while len(source.read(0.0)):
        pass


def format_of(source: SerialSensor | AnalogueSensor | SoundInput) -> SignalFormat:
    """Return the format of a live stream from a source. Raises CodecError."""
    if isinstance(source, SerialSensor):
        full_scale, rms = source.full_scale or _HIGHEST[source.unit], _EXPECTED_RMS[source.unit]
        return live_format(source.rate_hz, source.unit, [full_scale] * source.channels, [rms] * source.channels)
    return live_format(source.rate_hz, source.unit, [source.full_scale or 1.0] * source.channels)
