"""A signal ready to be coded: its format, how its packets are cut, and the stream that a setting makes of it."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Self, TypeAlias

import numpy as np

from vibrocast import textures
from vibrocast.codec import mdct
from vibrocast.codec.interface import (
    AUTO,
    Codec,
    CodecError,
    Encoder,
    Estimate,
    Framing,
    MeasuringEncoder,
    Setting,
    Signal,
    SignalFormat,
    chosen,
    number,
    parts,
    peak_of,
)
from vibrocast.codec.registry import DEFAULT_CODEC, codec_by_name
from vibrocast.codec.stream import MAX_GAIN, Stream, gain_for, image_hash
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT, StreamHeader
from vibrocast.models import Model

DEFAULT_STREAM_RATE_HZ = 2800
LIVE_PACKET_BLOCKS = 4
LIVE_REFRESH_S = 0.25
REFRESH_S = 2.0
"""Time from one refresh to the next in streams whose packets have a given duration or rate."""
_FILE_PACKET_BLOCKS = 128
_FILE_PACKET_SAMPLES = 4096
"""Samples over all channels of a packet that no host can split: each board in firmware/build.py takes it."""
_WHOLE_FILE_BLOCKS = 1024
"""Blocks over all channels of a recording that becomes one packet, if hosts can split it for a controller."""
MAX_PACKET_BYTES = 4000
"""Every packet fits into one frame of the wire protocol, so a file can be played as it is."""
_STEPS_BETWEEN = 8
"""Steps from one rate point to the next, if the setting is a fraction."""
_EXCERPT = 8
"""A signal this many times as long as an excerpt has one."""
_EXCERPT_PIECE = 1024
_BEGUN_SAMPLES = 1 << 9
"""Samples per channel that are coded at a time while a stream plays."""
_ROUNDING_ERROR = 1 / 12 / 32_768**2
"""Squared error of rounding a sample to 16 bits, relative to full scale."""
EXPECTED_RMS = 0.2
"""Assumed RMS value of a source, relative to its full scale, if nothing is known of it."""

Progress: TypeAlias = Callable[[float], None]


def live_framing(rate_hz: int) -> Framing:
    """Return the framing for streaming: packets of 4 blocks, a refresh at least every 0.25 s."""
    packet_samples = LIVE_PACKET_BLOCKS * mdct.hop_samples(rate_hz)
    return Framing(packet_samples, max(1, math.floor(LIVE_REFRESH_S * rate_hz / packet_samples)))


def timed_framing(packet_s: float, rate_hz: float) -> Framing:
    """Return the framing for packets of this duration in s, with a refresh every 2 s (REFRESH_S)."""
    return Framing(max(1, round(packet_s * rate_hz)), max(1, round(REFRESH_S / packet_s)))


def file_framing(codec: Codec, samples: int, rate_hz: int, channels: int) -> Framing:
    """Return the framing for a file: one refresh at the start, packets of at most 128 blocks over all channels.

    If the codec can split packets later, a short recording is one packet; if not, a packet has at most 4096 samples
    over all channels, so that it plays on every board.
    """
    hop = mdct.hop_samples(rate_hz)
    needed = -(-samples // hop) + 1
    most = _FILE_PACKET_BLOCKS
    if codec.repack is None:
        most = min(most, _FILE_PACKET_SAMPLES // hop)
    elif needed * channels <= _WHOLE_FILE_BLOCKS:
        most = needed * channels
    return Framing(min(needed, max(1, most // channels)) * hop, 0)


def encode(
    samples: Signal,
    rate_hz: int,
    setting: Setting,
    *,
    codec: str = DEFAULT_CODEC,
    unit: str = "full scale",
    live: bool = False,
    model: Model | None = None,
    progress: Progress | None = None,
    framing: Framing | None = None,
) -> Stream:
    """Code samples (n, channels) in a physical unit with a codec's setting; missing parameters have their defaults.

    The other parameters are as in `Source.of`. Raises CodecError as it, and for an invalid setting.
    """
    return Source.of(samples, rate_hz, codec, unit, live, model, progress, framing).encode(setting)


def live_format(
    rate_hz: int, unit: str, full_scales: Sequence[float], rms: Sequence[float] | None = None
) -> SignalFormat:
    """Return the format of a live source before its samples come.

    `full_scales`: the largest expected magnitude of each channel, in `unit`. `rms`: RMS values in `unit`; None =
    EXPECTED_RMS of full scale. Raises CodecError for a full scale that cannot be coded.
    """
    gains = tuple(gain_for(full_scale) for full_scale in full_scales)
    if rms is None:
        return SignalFormat(rate_hz, unit, gains, (EXPECTED_RMS,) * len(gains))
    relative = tuple(value / gain or 1.0 for value, gain in zip(rms, gains, strict=True))
    return SignalFormat(rate_hz, unit, gains, relative)


def recording_format(recording: textures.Recording) -> SignalFormat:
    """Return the format of a recording that is played live. Raises CodecError if it cannot be coded."""
    samples = recording.samples
    peaks = np.max(np.abs(samples), axis=0, initial=0.0)
    rms = np.sqrt(np.mean(np.square(samples), axis=0))
    return live_format(round(recording.rate_hz), recording.unit, peaks.tolist(), rms.tolist())


@dataclass(eq=False)
class Source:
    """A signal ready to be coded at any setting, as a file or as a live stream; `of` makes one.

    `samples`: float64 (n, channels) in the unit of `format`. `framing`: how packets are cut. `shape`: part of every
    setting that does not state it, as from `shape_setting`. `heard`: the channels that are not silent. `progress`:
    called with the finished part of a search, from 0 to 1. `whole`: the signal that an excerpt is of.
    """

    codec: Codec
    samples: Signal
    format: SignalFormat
    framing: Framing
    live: bool
    model: Model | None
    shape: Setting
    heard: list[int]
    progress: Progress | None = None
    whole: "Source | None" = None
    _trials: int = field(default=0, init=False)
    _choices: dict[tuple[tuple[str, str], ...], Setting] = field(default_factory=dict, init=False)

    @classmethod
    def of(
        cls,
        samples: Signal,
        rate_hz: int,
        codec: str = DEFAULT_CODEC,
        unit: str = "full scale",
        live: bool = False,
        model: Model | None = None,
        progress: Progress | None = None,
        framing: Framing | None = None,
        shape: Setting | None = None,
    ) -> Self:
        """Take samples (n, channels) in a physical unit.

        `live`: in short packets with regular refreshes, for streaming; otherwise in the fewest bytes, for a file.
        `framing`: None = as `live_framing` or `file_framing`. `shape`: None = the codec's default. Raises CodecError
        for an empty signal, NaN, infinity, or a channel count, level or unit that cannot be coded.
        """
        if samples.ndim != 2 or samples.shape[1] < 1:
            raise CodecError(f"samples of shape {samples.shape} do not fit; give (n, channels)")
        if len(samples) == 0:
            raise CodecError("the signal is empty; give at least one sample")
        if not all(np.all(np.isfinite(samples[part])) for part in parts(len(samples))):
            raise CodecError("the signal holds NaN or infinity; repair the recording first")
        known = codec_by_name(codec)
        known.check_model(model is not None)
        known.forget()
        if framing is None:
            framing = live_framing(rate_hz) if live else file_framing(known, len(samples), rate_hz, samples.shape[1])
        gains = tuple(gain_for(peak_of(channel)) for channel in samples.T)
        energies = sum(np.sum(np.square(samples[part] / np.array(gains)), axis=0) for part in parts(len(samples)))
        rms = tuple(math.sqrt(energy / len(samples)) or 1.0 for energy in np.atleast_1d(energies))
        # A height profile is loaded whole, however short its packets are.
        length = None if live and unit != PROFILE_UNIT else len(samples)
        signal_format = SignalFormat(rate_hz, unit, gains, rms, length)
        heard = np.flatnonzero(energies).tolist()
        return cls(known, samples, signal_format, framing, live, model, shape or {}, heard, progress)

    def encode(self, setting: Setting) -> Stream:
        """Code with a setting; shorten packets that grow too long. Raises CodecError as `codec.encode`.

        Few levels may raise the peak. A stream that only hosts decode gets a full scale that clips nothing of it.
        """
        setting, framing = self.resolved(setting), self.framing
        tried_samples = 0
        while True:
            encoder = self.codec.make_encoder(setting, self.format, framing, self.model, None)
            coded = self.coded(setting, encoder)
            as_short_as_can_be = encoder.packet_samples in (1, tried_samples)
            if max(map(len, coded.packets)) <= MAX_PACKET_BYTES or as_short_as_can_be:
                doubled = tuple(2 * gain for gain in self.format.gains)
                return self._with_gains(doubled).encode(setting) if self._clips(coded) else coded
            tried_samples = encoder.packet_samples
            framing = Framing(-(-framing.packet_samples // 2), 2 * framing.refresh_packets)

    def excerpt(self, samples: int) -> "Source | None":
        """Return pieces from all over a long signal, about this many samples per channel, to be coded as parts of it.

        They keep its `format`, so that a setting means the same. None for a signal that is not _EXCERPT times as long.
        """
        pieces = samples // _EXCERPT_PIECE
        if len(self.samples) < _EXCERPT * samples or pieces < 1:
            return None
        starts = np.linspace(0, len(self.samples) - _EXCERPT_PIECE, pieces).astype(int)
        cut = np.concatenate([self.samples[start : start + _EXCERPT_PIECE] for start in starts])
        signal_format = replace(self.format, samples=None if self.format.samples is None else len(cut))
        return replace(self, samples=cut, format=signal_format, progress=None, whole=self)

    def squared_errors(self, coded: Stream) -> Signal:
        """Return the sum of squared errors of each channel (channels,) in a stream of it, relative to full scale."""
        decoded, gains, errors = coded.decode(), np.array(self.format.gains), np.zeros(self.format.channels)
        for part in parts(len(decoded)):
            errors += np.sum(np.square((self.samples[part] - decoded[part]) / gains), axis=0)
        return errors

    def begin(self, setting: Setting) -> tuple[StreamHeader, Iterator[bytes]]:
        """Return the header, and the packets as they are asked for. Raises CodecError as `codec.encode`."""
        encoder = self.codec.make_encoder(self.resolved(setting), self.format, self.framing, self.model, None)

        def packets() -> Iterator[bytes]:
            for start in range(0, len(self.samples), _BEGUN_SAMPLES):
                yield from encoder.encode(self.samples[start : start + _BEGUN_SAMPLES] / np.array(self.format.gains))
            yield from encoder.finish()

        return self._header(encoder), packets()

    def _clips(self, coded: Stream) -> bool:
        """Return whether the peak of a stream that only hosts decode reaches full scale, which can be raised."""
        if not coded.decoder().hosts_only or 2 * max(coded.header.gains) > MAX_GAIN:
            return False
        decoded = coded.decode_integers()
        return max(int(decoded.max()), -int(decoded.min())) >= 32_767

    def with_full_scale(self, least: float) -> "Source":
        """Return the same signal with a full scale of each channel that is not below a value in the signal's unit."""
        return self._with_gains(tuple(max(gain, gain_for(least)) if least else gain for gain in self.format.gains))

    def _with_gains(self, gains: tuple[float, ...]) -> "Source":
        each = zip(self.format.rms, self.format.gains, gains, strict=True)
        rms = tuple(rms * own / gain for rms, own, gain in each)
        return replace(self, format=replace(self.format, gains=gains, rms=rms))

    def settings(self, given: Setting) -> list[Setting]:
        """Return the settings that a search for a quality tests, the coarsest first: `rate_points`, and steps between.

        There is nothing between them if a parameter that varies is no fraction. Raises CodecError.
        """
        rate_points = self.rate_points(given)
        pairs = list(itertools.pairwise(rate_points))
        varied = {name for low, high in pairs for name in low if low[name] != high[name]}
        if not all(self.codec.parameters[name].fractional for name in varied):
            return rate_points
        finer: list[Setting] = []
        for (low, high), step in itertools.product(pairs, range(_STEPS_BETWEEN)):
            part = step / _STEPS_BETWEEN
            between = {name: (1 - part) * number(low, name) + part * number(high, name) for name in varied}
            finer.append({**low, **between})
        return [*finer, rate_points[-1]]

    def rate_points(self, given: Setting) -> list[Setting]:
        """Return the rate points of the codec's first set, with the given part of a setting in place of theirs.

        Leaves out those that the codec rejects. If it rejects all, returns all: the first one then raises the error.
        Raises CodecError for an invalid part.
        """
        given = self.codec.checked(given)
        rate_points: list[Setting] = []
        for rate_point in ({**rate_point, **given} for rate_point in self.codec.rate_points):
            if rate_point not in rate_points:
                rate_points.append(rate_point)
        return [rate_point for rate_point in rate_points if self._takes(rate_point)] or rate_points

    def _takes(self, setting: Setting) -> bool:
        """Return whether the codec accepts this setting with this model."""
        try:
            complete = self.codec.complete({**self.shape, **setting})
            self.codec.make_encoder(complete, self.format, self.framing, self.model, None)
        except CodecError:
            return False
        return True

    def resolved(self, setting: Setting) -> Setting:
        """Return the complete setting that `encode` uses, with the codec's own choices. Raises CodecError."""
        setting = self.codec.complete({**self.shape, **setting})
        if self.live or self.codec.resolve is None or AUTO not in setting.values():
            return setting
        words = tuple(sorted((name, value) for name, value in setting.items() if isinstance(value, str)))
        choice = (self.whole or self)._choice(words)
        return chosen(setting, choice)

    def estimate(self, given: Setting) -> Estimate | None:
        """Return an estimate of coding with a part of the setting, by the step; None where the codec has none."""
        estimate_part = None if self.codec.steps is None else self.codec.steps.estimate
        if estimate_part is None:
            return None
        setting, count = self.resolved(given), len(self.samples)
        estimates = [
            (
                len(self.samples[part]) / count,
                estimate_part(self.samples[part], self.format, setting, self.model),
            )
            for part in parts(count)
        ]

        def mean(step: float) -> tuple[float, Signal]:
            each = [(share, *estimate(step)) for share, estimate in estimates]
            errors: Signal = np.sum([share * error for share, _, error in each], axis=0)
            return sum(share * bits for share, bits, _ in each), errors

        return mean

    def _choice(self, words: tuple[tuple[str, str], ...]) -> Setting:
        """Return the codec's choices for this signal: the same at every number, so that a search meets no jump."""
        assert self.codec.resolve is not None, f"{self.codec.name} has parameters that may be {AUTO}"
        if words not in self._choices:
            self._choices[words] = self.codec.resolve(self.samples, self.format, self.model, dict(words))
        return self._choices[words]

    def coded(self, setting: Setting, encoder: Encoder) -> Stream:
        """Return the stream that an encoder of a complete setting makes of the signal. Raises CodecError."""
        packets: list[bytes] = []
        for part in parts(len(self.samples)):
            packets += encoder.encode(self.samples[part] / np.array(self.format.gains))
            if self.progress is not None:
                # The number of a search's trials is not known before: each gets half of the rest of the progress bar.
                within = min(part.stop, len(self.samples)) / len(self.samples)
                self.progress(1 - 0.5**self._trials * (1 - within / 2))
        self._trials += 1
        packets += encoder.finish()
        errors = None
        if isinstance(encoder, MeasuringEncoder) and (measured := encoder.squared_errors) is not None:
            samples = len(self.samples)
            within = samples / (samples + encoder.delay_samples)  # the first and the last window reach beyond the ends
            errors = tuple(within * error + samples * _ROUNDING_ERROR for error in measured)
        image = None if self.model is None else self.model.image
        return Stream(self._header(encoder), tuple(packets), image, setting=setting, squared_errors=errors)

    def _header(self, encoder: Encoder) -> StreamHeader:
        return StreamHeader(
            self.codec.identifier,
            self.format.rate_hz,
            len(self.samples),
            self.format.unit,
            self.format.gains,
            encoder.configuration,
            b"" if self.model is None else image_hash(self.model.image),
        )
