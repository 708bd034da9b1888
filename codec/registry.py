"""All codecs by name; encodes whole signals with a given setting, and decodes them."""

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from vibrocast.codec import dct, eva, mdct, parametric, plugins, shaping, slp
from vibrocast.codec.interface import (
    AUTO,
    Codec,
    CodecError,
    CodedSignal,
    Decoded,
    Decoder,
    Encoder,
    Estimate,
    Framing,
    MeasuringEncoder,
    Model,
    Setting,
    Signal,
    SignalFormat,
)
from vibrocast.codec.rate_control import RatePolicy, rate_controlled_encoder
from vibrocast.codec.threshold import PHYSICAL_UNITS
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT

LIVE_PACKET_BLOCKS = 4
LIVE_REFRESH_S = 0.25
_FILE_PACKET_BLOCKS = 128
_FILE_PACKET_SAMPLES = 4096
"""Samples over all channels of a packet that no host can split: each board in firmware/build.py takes it."""
_WHOLE_FILE_BLOCKS = 1024
"""Blocks over all channels of a recording that becomes one packet, if hosts can split it for a controller."""
# Every packet fits into one frame of the wire protocol, so a file can be played as it is.
_MAX_PACKET_BYTES = 4000
_PART_SAMPLES = 1 << 20
_ROUNDING_ERROR = 1 / 12 / 32_768**2
"""Squared error of rounding a sample to 16 bits, relative to full scale."""
_MAX_GAIN = 2.0**127
_MIN_GAIN = 2.0**-120

Progress: TypeAlias = Callable[[float], None]

BUILT_IN: dict[str, Codec] = {
    codec.name: codec for codec in (mdct.CODEC, dct.CODEC, slp.CODEC, eva.CODEC, parametric.CODEC)
}
PEERS: dict[str, Codec] = {}
"""Codecs of other projects that a benchmark adds: they are found by name and number, and not listed in CODECS."""
_REMOVED = {5: "opus", 6: "amr-nb", 7: "g723-1", 8: "g726", 9: "wavpack", 10: "flac", 12: "lapped"}
"""Numbers in stream headers that no other codec may take."""
DEFAULT_CODEC = mdct.NAME


class Codecs(Mapping[str, Codec]):
    """All codecs by name: the built-in ones, those of other packages (codec/plugins.py), those added in this process.

    The packages are loaded at first use. `failures`: errors of packages' codecs that cannot be used, by entry point.
    """

    def __init__(self) -> None:
        self._added: dict[str, Codec] = {}

    def add(self, codec: Codec) -> None:
        """Add a codec, or replace an added one. Raises CodecError if a package or vibrocast has the name."""
        if codec.name in self._loaded[0]:
            raise CodecError(f"there is a codec {codec.name} already; rename yours")
        self._added[codec.name] = codec

    @cached_property
    def _loaded(self) -> tuple[dict[str, Codec], dict[str, str]]:
        others, failures = plugins.load(BUILT_IN)
        return {**BUILT_IN, **others}, failures

    @property
    def failures(self) -> dict[str, str]:
        """Why codecs of packages cannot be used, by entry point."""
        return self._loaded[1]

    def __getitem__(self, name: str) -> Codec:
        return BUILT_IN.get(name) or self._added.get(name) or self._loaded[0][name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._loaded[0], **self._added})

    def __len__(self) -> int:
        return len(self._loaded[0]) + len(self._added)


CODECS = Codecs()


def codec_by_name(name: str) -> Codec:
    """Return the codec of that name. Raises CodecError when there is none."""
    for known in (CODECS, PEERS):
        if name in known:
            return known[name]
    if name in CODECS.failures:
        raise CodecError(f"the codec {name} cannot be loaded: {CODECS.failures[name]}; repair or remove its package")
    raise CodecError(f"there is no codec {name!r}; choose one of {', '.join(sorted(CODECS))}")


def codec_by_identifier(identifier: int, configuration: bytes = b"") -> Codec:
    """Return the codec of this number in stream headers. Raises CodecError when there is none.

    `configuration`: the header's, which names a codec of another package.
    """
    if identifier == plugins.IDENTIFIER:
        name = plugins.name_in(configuration)
        if name not in CODECS:
            raise CodecError(f"the stream needs the codec {name!r}; install the package that brings it, or register it")
        return CODECS[name]
    for codec in (*BUILT_IN.values(), *PEERS.values()):
        if codec.identifier == identifier:
            return codec
    if identifier in _REMOVED:
        raise CodecError(
            f"the stream has the former codec {_REMOVED[identifier]}, which only earlier versions play; encode the "
            "recording again"
        )
    raise CodecError(f"the stream needs codec number {identifier}, which this version lacks; update vibrocast")


def decoder(
    identifier: int, configuration: bytes, channels: int, tables: bytes | None = None, runtime: str | None = None
) -> Decoder:
    """Make the decoder of a stream from its header's fields. Raises CodecError when they do not fit a codec.

    `runtime`: one of RUNTIMES, for tables that either can decode; None = as the tables say.
    """
    codec = codec_by_identifier(identifier, configuration)
    _check_model(codec, tables is not None)
    if runtime is not None and tables is not None and codec.with_runtime is not None:
        tables = codec.with_runtime(tables, runtime)
    return codec.make_decoder(configuration, channels, tables)


def check_tables(identifier: int, tables: bytes) -> None:
    """Raise CodecError for the payload of a model image that a codec's decoders reject."""
    codec = codec_by_identifier(identifier)
    _check_model(codec, given=True)
    assert codec.check_tables is not None, f"{codec.name} takes a model"
    codec.check_tables(tables)


def live_framing(rate_hz: int) -> Framing:
    """Return the framing for streaming: packets of 4 blocks, a refresh at least every 0.25 s."""
    packet_samples = LIVE_PACKET_BLOCKS * mdct.hop_samples(rate_hz)
    return Framing(packet_samples, max(1, math.floor(LIVE_REFRESH_S * rate_hz / packet_samples)))


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


def gain_for(peak: float) -> float:
    """Return the smallest number of 8 significant bits that is not below `peak`; 1 for silence.

    Raises CodecError outside 2^-120 to 2^127.
    """
    if peak == 0:
        return 1.0
    if not _MIN_GAIN <= peak <= _MAX_GAIN:
        raise CodecError(f"the signal's peak {peak:g} is outside {_MIN_GAIN:.0e} to {_MAX_GAIN:.0e}; use another unit")
    mantissa, exponent = math.frexp(peak)
    return math.ldexp(math.ceil(mantissa * 256), exponent - 8)


def nearest_gain(gain: float) -> float:
    """Return the number of 8 significant bits that is nearest. Raises CodecError as `gain_for`."""
    mantissa, exponent = math.frexp(gain)
    return gain_for(math.ldexp(round(mantissa * 256), exponent - 8))


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
) -> CodedSignal:
    """Code samples (n, channels) in a physical unit with a codec's setting; missing parameters have their defaults.

    `live`: in short packets with regular refreshes, for streaming; otherwise in the fewest bytes, for a file.
    `framing`: how the packets of a live stream are cut; None = as `live_framing`. `progress` is called with the
    finished part, from 0 to 1. Raises CodecError for an empty signal, NaN, infinity, an invalid setting, or a channel
    count, level or unit that cannot be coded.
    """
    return Source(samples, rate_hz, codec, unit, live, model, progress, framing).encode(setting)


def decode_integers(coded: CodedSignal, tables: bytes | None = None) -> Decoded:
    """Decode every packet: int16 (packets * packet_samples, channels), including the codec's delay at the beginning.

    Raises CodecError on a malformed packet or configuration.
    """
    state = decoder(codec_by_name(coded.codec).identifier, coded.configuration, coded.channels, tables)
    decoded = np.empty((len(coded.packets) * state.packet_samples, coded.channels), dtype=np.int16)
    for index, packet in enumerate(coded.packets):
        decoded[index * state.packet_samples : (index + 1) * state.packet_samples] = state.decode(packet)
    return decoded


def decode(coded: CodedSignal, tables: bytes | None = None) -> Signal:
    """Decode to float64 (samples, channels) in the physical unit, without the codec's delay.

    Raises CodecError on a malformed packet or configuration, and when packets are missing at the end.
    """
    state = decoder(codec_by_name(coded.codec).identifier, coded.configuration, coded.channels, tables)
    end = state.delay_samples + coded.samples
    held = len(coded.packets) * state.packet_samples
    if coded.samples and held < end:
        raise CodecError(f"the stream is cut short: it holds {held} of {end} samples; copy the file again")
    integers = decode_integers(coded, tables)[state.delay_samples : end]
    return integers * (np.array(coded.gains) / 32768)


def parts(samples: int) -> Iterator[slice]:
    """Yield slices that cover a long signal, so that work on it needs no copy of the whole."""
    for start in range(0, samples, _PART_SAMPLES):
        yield slice(start, start + _PART_SAMPLES)


def peak_of(channel: Signal) -> float:
    """Return the largest magnitude of a channel (n,); 0 for no samples."""
    return max(float(np.max(channel, initial=0.0)), -float(np.min(channel, initial=0.0)))


def _check_model(codec: Codec, given: bool) -> None:
    if given and not codec.takes_model:
        raise CodecError(f"the codec {codec.name} takes no model image; leave it out")
    if codec.needs_model and not given:
        raise CodecError(f"the codec {codec.name} needs a model; give one of its model images")


def shape_setting(
    codec: Codec, touch: float | None, rate_hz: float, unit: str, setting: Setting | None = None
) -> Setting:
    """Return the part of a codec's setting that serves touch, with a strength from 0, flat, to 1.

    `touch`: None = the default where the codec has shapes and the unit is physical, else 0. `setting`: what else is
    given; a shape in it stands before the default. Raises CodecError as `shaping.touch_shape`, where both a strength
    and a shape are given, and for a strength above 0 of a codec without shapes.
    """
    has_shapes = codec.shape_parameter is not None
    given = has_shapes and codec.shape_parameter in (setting or {})
    if touch is None:
        touch = shaping.DEFAULT_TOUCH if has_shapes and not given and unit in PHYSICAL_UNITS else 0.0
    elif given:
        raise CodecError("a strength of touch and a shape are both given; give one of them")
    if touch == 0 or codec.shape_parameter is None:
        if touch != 0:
            raise CodecError(f"{codec.name} cannot shape its error for touch; choose {DEFAULT_CODEC}, or a touch of 0")
        return {}
    return {codec.shape_parameter: shaping.shape_text(shaping.touch_shape(touch, rate_hz, unit))}


_EXCERPT = 8
"""A signal this many times as long as an excerpt has one."""
_EXCERPT_PIECE = 1024


class Source:
    """A signal ready to be coded at any setting, as a file or as a live stream.

    `format`: its properties for the encoder. `silent`: whether every channel is.
    """

    def __init__(
        self,
        samples: Signal,
        rate_hz: int,
        codec: str = DEFAULT_CODEC,
        unit: str = "full scale",
        live: bool = False,
        model: Model | None = None,
        progress: Progress | None = None,
        framing: Framing | None = None,
        shape: Setting | None = None,
    ) -> None:
        """Take samples (n, channels) in a physical unit; the parameters are as in `encode`. Raises CodecError.

        `shape`: part of every setting that does not state it, as from `shape_setting`; None = the codec's default.
        """
        if samples.ndim != 2 or samples.shape[1] < 1:
            raise CodecError(f"samples of shape {samples.shape} do not fit; give (n, channels)")
        if len(samples) == 0:
            raise CodecError("the signal is empty; give at least one sample")
        if not all(np.all(np.isfinite(samples[part])) for part in parts(len(samples))):
            raise CodecError("the signal holds NaN or infinity; repair the recording first")
        self.codec = codec_by_name(codec)
        _check_model(self.codec, model is not None)
        self.codec.forget()
        self.samples = samples
        self.model = model
        self._progress = progress or (lambda part: None)
        self._live = live
        if framing is None:
            framing = (
                live_framing(rate_hz) if live else file_framing(self.codec, len(samples), rate_hz, samples.shape[1])
            )
        self._framing = framing
        gains = tuple(gain_for(peak_of(channel)) for channel in samples.T)
        energies = sum(np.sum(np.square(samples[part] / np.array(gains)), axis=0) for part in parts(len(samples)))
        rms = tuple(math.sqrt(energy / len(samples)) or 1.0 for energy in np.atleast_1d(energies))
        # A height profile is loaded whole, however short its packets are.
        length = None if live and unit != PROFILE_UNIT else len(samples)
        self.format = SignalFormat(rate_hz, unit, gains, rms, length)
        self.silent = not np.any(energies)
        self._shape = shape or {}
        self._trials = 0
        self._whole = self
        self._choices: dict[tuple[tuple[str, str], ...], Setting] = {}

    def encode(self, setting: Setting) -> CodedSignal:
        """Code with a setting; shorten packets that grow too long. Raises CodecError as `codec.encode`.

        Few levels may raise the peak. A stream that only hosts decode gets a full scale that clips nothing of it.
        """
        setting = self.resolved(setting)
        framing = self._framing
        tried_samples = 0
        while True:
            encoder = self.codec.make_encoder(setting, self.format, framing, self.model, None)
            packets = self._packets(encoder)
            as_short_as_can_be = encoder.packet_samples in (1, tried_samples)
            if max(map(len, packets)) <= _MAX_PACKET_BYTES or as_short_as_can_be:
                coded = self._coded(encoder, packets)
                return self._doubled().encode(setting) if self._clips(coded) else coded
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
        excerpt = copy.copy(self)  # its `_whole` makes the codec's choices
        excerpt.samples = np.concatenate([self.samples[start : start + _EXCERPT_PIECE] for start in starts])
        excerpt.format = replace(self.format, samples=None if self.format.samples is None else len(excerpt.samples))
        excerpt._progress = lambda part: None
        return excerpt

    def encode_rate_controlled(self, setting: Setting, policy: RatePolicy, framing: Framing) -> CodedSignal:
        """Code in one pass, like a live stream, with a policy that controls the rate.

        Raises CodecError as `encode`, and for packets longer than 4000 bytes; TargetUnreachable as
        `rate_controlled_encoder`.
        """
        encoder = rate_controlled_encoder(self.codec, self.resolved(setting), self.format, framing, self.model, policy)
        packets = self._packets(encoder)
        if max(map(len, packets)) > _MAX_PACKET_BYTES:
            raise CodecError(
                f"a packet of {max(map(len, packets))} bytes, and a controller need not take more than "
                f"{_MAX_PACKET_BYTES}; choose shorter packets, or a lower rate or quality"
            )
        return self._coded(encoder, packets)

    def _clips(self, coded: CodedSignal) -> bool:
        """Return whether the peak of a stream that only hosts decode reaches full scale, which can be raised."""
        if not self.codec.only_hosts_decode(coded.configuration) or 2 * max(coded.gains) > _MAX_GAIN:
            return False
        decoded = decode_integers(coded)
        return max(int(decoded.max()), -int(decoded.min())) >= 32_767

    def _doubled(self) -> "Source":
        """Return the same signal with twice the full scale."""
        doubled = copy.copy(self)
        gains, rms = (
            tuple(factor * each for each in part) for factor, part in ((2, self.format.gains), (0.5, self.format.rms))
        )
        doubled.format = replace(self.format, gains=gains, rms=rms)
        return doubled

    def takes(self, setting: Setting) -> bool:
        """Return whether the codec accepts this setting with this model."""
        try:
            complete = self.codec.complete({**self._shape, **setting})
            self.codec.make_encoder(complete, self.format, self._framing, self.model, None)
        except CodecError:
            return False
        return True

    def resolved(self, setting: Setting) -> Setting:
        """Return the complete setting that `encode` uses, with the codec's own choices. Raises CodecError."""
        setting = self.codec.complete({**self._shape, **setting})
        if self._live or self.codec.resolve is None or AUTO not in setting.values():
            return setting
        words = tuple(sorted((name, value) for name, value in setting.items() if isinstance(value, str)))
        choice = self._whole._choice(words)
        return {name: choice[name] if value == AUTO else value for name, value in setting.items()}

    def estimate(self) -> Estimate | None:
        """Return an estimate of coding with default parameters, by the step; None where the codec has none."""
        if self.codec.estimate is None:
            return None
        setting, count = self.resolved({}), len(self.samples)
        estimates = [
            (len(self.samples[part]) / count, self.codec.estimate(self.samples[part], self.format, setting, self.model))
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

    def _coded(self, encoder: Encoder, packets: list[bytes]) -> CodedSignal:
        errors = None
        if isinstance(encoder, MeasuringEncoder) and (measured := encoder.squared_errors) is not None:
            samples = len(self.samples)
            within = samples / (samples + encoder.delay_samples)  # the first and the last window reach beyond the ends
            errors = tuple(within * error + samples * _ROUNDING_ERROR for error in measured)
        return CodedSignal(
            self.codec.name,
            self.format.rate_hz,
            len(self.samples),
            self.format.gains,
            encoder.configuration,
            tuple(packets),
            errors,
        )

    def _packets(self, encoder: Encoder) -> list[bytes]:
        packets: list[bytes] = []
        for part in parts(len(self.samples)):
            packets += encoder.encode(self.samples[part] / np.array(self.format.gains))
            # The number of a search's trials is not known before: each gets half of the rest of the progress bar.
            within = min(part.stop, len(self.samples)) / len(self.samples)
            self._progress(1 - 0.5**self._trials * (1 - within / 2))
        self._trials += 1
        return packets + encoder.finish()
