"""The interface that every codec implements: its setting, an encoder and a decoder of packets, each with its state."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import MAX_CHANNELS
from vibrocast.errors import InputError
from vibrocast.models import Model as Model

Signal = NDArray[np.float64]
Decoded = NDArray[np.int16]
Value: TypeAlias = float | str | tuple[float, ...]
_PART_SAMPLES = 1 << 20
Setting: TypeAlias = Mapping[str, Value]
"""A codec's parameters by name. A tuple has a number for each channel, where a parameter may differ by channel."""

AUTO = "auto"
"""The value of a parameter that the codec chooses."""
WHOLE = "whole"
"""The block that is a whole file. A live stream cannot have it, and a controller cannot decode it."""
RUNTIMES = ("core", "onnx")
"""The decoders of a learned codec: the integer core, or ONNX Runtime."""


class CodecError(InputError):
    """A signal, parameter, configuration or packet that the codec rejects; the message says why and what to do."""


class TargetUnreachable(CodecError):
    """An SNR or a rate that this codec and model cannot reach with this signal; others may."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a codec: its meaning, its default, its allowed values.

    A value is one of the words in `choices`; or any text, if `text`; or a number from `low` to `high`, a whole one if
    `whole`. With `per_channel` it may also be a tuple of such numbers, one for each channel. `is_block`: whether it is
    the length of a block in samples.
    """

    meaning: str
    default: float | str
    low: float = -math.inf
    high: float = math.inf
    whole: bool = False
    choices: tuple[str, ...] = ()
    text: bool = False
    per_channel: bool = False
    is_block: bool = False

    def checked(self, name: str, value: Value) -> Value:
        """Return the value, converted if it is a number in text.

        Raises:
            CodecError: The parameter `name` cannot have that value.
        """
        if isinstance(value, tuple):
            if not self.per_channel:
                raise CodecError(f"{name} is {value}; give one value, the same for every channel")
            return tuple(self._number(name, part) for part in value)
        if self.text:
            return str(value)
        if self.choices:
            if value not in self.choices:
                raise CodecError(f"{name} is {value!r}; choose one of {', '.join(self.choices)}")
            return value
        return self._number(name, value)

    @property
    def fractional(self) -> bool:
        """Whether the value is a number that need not be whole."""
        return not (self.whole or self.text or self.choices)

    @property
    def range(self) -> str:
        """The allowed values, in words."""
        if self.choices:
            return ", ".join(self.choices)
        if self.text:
            return "text"
        kind = "whole number" if self.whole else "number"
        limits = [f"from {self.low:g}" * math.isfinite(self.low), f"up to {self.high:g}" * math.isfinite(self.high)]
        return " ".join([kind, *filter(None, limits)])

    def _number(self, name: str, value: float | str) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not (math.isfinite(number) and self.low <= number <= self.high and (number.is_integer() or not self.whole)):
            raise CodecError(f"{name} is {value}; it must be a {self.range}")
        return int(number) if self.whole else number


def number(setting: Setting, name: str) -> float:
    """Return a parameter of a checked setting that is one number."""
    value = setting[name]
    assert isinstance(value, (float, int)), f"{name} is one number"
    return value


def numbers(setting: Setting, name: str, channels: int) -> tuple[float, ...]:
    """Return a parameter as one number for each channel. Raises CodecError for a wrong count of numbers."""
    value = setting[name]
    if not isinstance(value, tuple):
        return (number(setting, name),) * channels
    if len(value) != channels:
        raise CodecError(f"{name} has {len(value)} values for {channels} channels; give one, or one for each")
    return value


def word(setting: Setting, name: str) -> str:
    """Return a parameter of a checked setting as a word."""
    return str(setting[name])


def check_channels(channels: int) -> None:
    """Raise CodecError for a channel count that no stream can have."""
    if not 1 <= channels <= MAX_CHANNELS:
        raise CodecError(f"{channels} channels do not fit a stream; give 1 to {MAX_CHANNELS}")


def checked_parts(samples: Signal, channels: int, part_samples: int) -> Iterator[Signal]:
    """Yield the input of an encoder, clipped to full scale, in parts of at most `part_samples` samples.

    Raises CodecError on a wrong shape, NaN or infinity.
    """
    if samples.ndim != 2 or samples.shape[1] != channels:
        raise CodecError(f"samples of shape {samples.shape} do not fit; give (n, {channels})")
    for start in range(0, len(samples), part_samples):
        part = np.asarray(samples[start : start + part_samples], dtype=np.float64)
        if not np.all(np.isfinite(part)):
            raise CodecError("the signal holds NaN or infinity; repair the recording first")
        yield np.clip(part, -1.0, 1.0)


def parts(samples: int) -> Iterator[slice]:
    """Yield slices that cover a long signal, so that work on it needs no copy of the whole."""
    for start in range(0, samples, _PART_SAMPLES):
        yield slice(start, start + _PART_SAMPLES)


def peak_of(channel: Signal) -> float:
    """Return the largest magnitude of a channel (n,); 0 for no samples."""
    return max(float(np.max(channel, initial=0.0)), -float(np.min(channel, initial=0.0)))


@dataclass(frozen=True)
class SignalFormat:
    """Properties of a signal that an encoder must know before the samples come.

    `gains`: physical value of each channel's full scale, in `unit`. `rms`: RMS value of each channel relative to full
    scale, 1 for silence. `unit`: "full scale", "m/s^2", "um" or PROFILE_UNIT, where `rate_hz` is in samples per metre.
    `samples`: samples per channel; None = unknown, as for a live stream.
    """

    rate_hz: int
    unit: str
    gains: tuple[float, ...]
    rms: tuple[float, ...]
    samples: int | None = None

    @property
    def channels(self) -> int:
        """Channels in the signal."""
        return len(self.gains)


@dataclass(frozen=True)
class Framing:
    """How a stream is cut into packets.

    `packet_samples`: samples per channel in each packet, rounded up to whole blocks. `refresh_packets`: packets from
    one refresh to the next; 0 = only the first packet is a refresh.
    """

    packet_samples: int
    refresh_packets: int


@dataclass(frozen=True)
class Trial:
    """A packet whose quality is still open. The encoder has all of its input, and no later input.

    `samples`: the input that the packet's decoded samples stand for, float64 (packet_samples, channels), full scale =
    1. It is delayed as the codec's output is. `quantiser_offsets`: the offsets to choose from, the finest first. 0 is
    the stream's own setting; a larger one is coarser and usually takes fewer bytes. `previous`: the offset of the
    packet before, which takes the fewest bytes to state, except in a refresh. `code`: codes the packet at an offset,
    and leaves the encoder as it was.
    """

    samples: Signal
    quantiser_offsets: range
    previous: int
    code: Callable[[int], bytes]

    def packet(self, quantiser_offset: int) -> bytes:
        """Return the packet at one of the offsets. Raises CodecError for others, and if it would be too long."""
        if quantiser_offset not in self.quantiser_offsets:
            raise CodecError(
                f"a quantiser offset of {quantiser_offset}; "
                f"choose {self.quantiser_offsets[0]} to {self.quantiser_offsets[-1]}"
            )
        return self.code(quantiser_offset)


@dataclass(frozen=True)
class Choice:
    """The choice for a packet: its quantiser offset, and the bytes to which a shorter packet is padded."""

    quantiser_offset: int
    min_bytes: int = 0


RateControl: TypeAlias = Callable[[Trial], Choice]
"""Chooses the quality of each packet of one stream, packet after packet."""


class Encoder(Protocol):
    """Turns normalised samples into packets of equal duration; keeps the state of one stream."""

    @property
    def configuration(self) -> bytes:
        """The bytes from which `Codec.decoder` makes a matching decoder; they go into the stream's header."""

    @property
    def packet_samples(self) -> int:
        """Samples per channel in every packet."""

    @property
    def delay_samples(self) -> int:
        """Samples per channel by which the decoded signal lags the input; `finish` codes as many after the end."""

    def encode(self, samples: Signal) -> list[bytes]:
        """Take samples (n, channels), full scale = 1; return the packets that they complete.

        Raises CodecError on a wrong shape, NaN or infinity.
        """

    def finish(self) -> list[bytes]:
        """Pad the end with zeros; return the remaining packets, so that every input sample can be decoded."""


@runtime_checkable
class MeasuringEncoder(Encoder, Protocol):
    """An encoder that knows its error without decoding."""

    @property
    def squared_errors(self) -> tuple[float, ...] | None:
        """The squared error of each channel in all packets so far, relative to full scale, but for final rounding."""


class Decoder(Protocol):
    """Turns packets into samples; keeps the state of one stream."""

    @property
    def channels(self) -> int:
        """Channels in the stream."""

    @property
    def packet_samples(self) -> int:
        """Samples per channel in every packet."""

    @property
    def delay_samples(self) -> int:
        """Samples per channel by which the decoded signal lags the encoder's input."""

    @property
    def hosts_only(self) -> bool:
        """Whether no controller decodes such a stream."""

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet; return int16 samples (packet_samples, channels), 32768 = full scale.

        After a missing packet, the decoder plays nothing until a refresh: the result fades to silence. Raises
        CodecError on a malformed packet; `conceal` then fills its time.
        """

    def conceal(self) -> Decoded:
        """Replace one missing packet: same shape as `decode`, the last sound faded out, then silence."""


Estimate: TypeAlias = Callable[[float], tuple[float, Signal]]
"""Returns, for a step, about how many bits coding takes for each sample of all channels, and the mean squared error
(channels,) relative to full scale.
"""


@dataclass(frozen=True)
class LearnedTransform:
    """The network of a trained model: channels of its hidden layers, bytes of its ONNX graph."""

    width: int
    graph_bytes: int


@dataclass(frozen=True)
class ModelTables:
    """How a codec decodes with the tables of a model, the payload of its image. All but `built_in` raise CodecError.

    `check`: raises it for a payload that decoders reject. `built_in`: returns the built-in tables; None = a model is
    needed. `with_runtime`: returns a payload that one of RUNTIMES decodes. `runtime_of`: returns which of RUNTIMES
    decodes a payload. `learned_transform`: describes the transform of a payload.
    """

    check: Callable[[bytes], None]
    built_in: Callable[[], bytes] | None = None
    with_runtime: Callable[[bytes, str], bytes] | None = None
    runtime_of: Callable[[bytes], str] = lambda payload: "core"
    learned_transform: Callable[[bytes], LearnedTransform | None] = lambda payload: None


@dataclass(frozen=True)
class Steps:
    """How a search varies the steps of a codec's quantiser, and `rd_weight` too, if there is one.

    `parameter`: to which the steps of a channel are proportional, relative to its RMS value. `range`: returns the
    smallest and the largest for a format. `estimate`: called with samples in their unit, the format, the complete
    setting and the model. Returns an estimate of coding them, where the search can begin; None = the codec has none.
    """

    parameter: str
    range: Callable[[SignalFormat], tuple[float, float]]
    estimate: Callable[[Signal, SignalFormat, Setting, Model | None], Estimate] | None = None


@dataclass(frozen=True)
class RatePoints:
    """A curve of settings, the coarsest first; defaults complete them.

    `is_physical`: whether it needs a signal in a physical unit. `is_variant`: whether a benchmark measures it only
    where it names it.
    """

    settings: tuple[Setting, ...]
    is_physical: bool = False
    is_variant: bool = False


@dataclass(frozen=True)
class Codec:
    """A codec: its name, its parameters, and how to make encoders and decoders.

    Other modules know nothing else of a codec, and none of them names one.

    Attributes:
        name: The name, as in `--codec`.
        identifier: The number in stream headers.
        summary: One line for `vibrocast codecs`.
        parameters: The parameters of a setting by name.
        rate_point_sets: Curves by name. A search for an SNR or a rate uses the first one, and goes between its points
            where a fraction varies.
        make_encoder: Called with the complete setting, the format, the framing, the model and the rate control. The
            rate control chooses the quality of each packet; None: all packets have that of the setting.
        make_decoder: Called with the configuration, the number of channels and the tables; None: built-in tables.
        resolve: Called with the samples of a file in their unit, or None for a live stream of the least delay; the
            format, the model, and the words in the complete setting. Returns the parameters that are "auto" among
            these; None where no signal decides on them.
        tables: What a model brings; None where no model brings tables.
        steps: The steps of the quantiser; None = a search uses rate points.
        repack: Called with the configuration, the number of channels, the tables, the packets and the most samples of
            a packet. Returns the configuration and the packets of the same signal with such packets. Raises CodecError,
            and StreamError for a malformed packet; None where the layout does not allow it.
        controls_rate: Whether encoders take a rate control.
        keeps_waveform: Whether decoded samples come near the input, so that an SNR can be a target.
        forget: Drops what encoders keep of a signal for their next trial with it; called before each new signal.
    """

    name: str
    identifier: int
    summary: str
    parameters: Mapping[str, Parameter]
    rate_point_sets: Mapping[str, RatePoints]
    make_encoder: Callable[[Setting, SignalFormat, Framing, Model | None, RateControl | None], Encoder]
    make_decoder: Callable[[bytes, int, bytes | None], Decoder]
    resolve: Callable[[Signal | None, SignalFormat, Model | None, Setting], Setting] | None = None
    tables: ModelTables | None = None
    steps: Steps | None = None
    repack: Callable[[bytes, int, bytes | None, Sequence[bytes], int], tuple[bytes, list[bytes]]] | None = None
    controls_rate: bool = False
    keeps_waveform: bool = True
    forget: Callable[[], None] = lambda: None

    @property
    def needs_model(self) -> bool:
        """Whether there are no built-in tables."""
        return self.tables is not None and self.tables.built_in is None

    def check_model(self, given: bool) -> None:
        """Raise CodecError where the codec takes no model and one is given, or needs one."""
        if given and self.tables is None:
            raise CodecError(f"the codec {self.name} takes no model image; leave it out")
        if self.needs_model and not given:
            raise CodecError(f"the codec {self.name} needs a model; give one of its model images")

    def decoder(
        self, configuration: bytes, channels: int, tables: bytes | None = None, runtime: str | None = None
    ) -> Decoder:
        """Make the decoder of a stream from its header's fields. Raises CodecError when they do not fit the codec.

        `runtime`: one of RUNTIMES, for tables that either can decode; None = as the tables say.
        """
        self.check_model(tables is not None)
        if runtime is not None and tables is not None and self.tables is not None and self.tables.with_runtime:
            tables = self.tables.with_runtime(tables, runtime)
        return self.make_decoder(configuration, channels, tables)

    @property
    def rate_points(self) -> tuple[Setting, ...]:
        """The settings of the first curve."""
        return next(iter(self.rate_point_sets.values())).settings

    @property
    def block_parameter(self) -> str | None:
        """The parameter that is the length of a block in samples; None where there is one length only."""
        return next((name for name, parameter in self.parameters.items() if parameter.is_block), None)

    @property
    def blocks(self) -> tuple[str, ...]:
        """The values of `block_parameter` except "auto" and "whole"; empty without such a parameter."""
        choices = self.parameters[self.block_parameter].choices if self.block_parameter else ()
        return tuple(choice for choice in choices if choice not in (AUTO, WHOLE))

    @property
    def one_rate_a_model(self) -> bool:
        """Whether each model is one rate point: a model is needed, and there is one setting."""
        return self.needs_model and len(self.rate_points) == 1

    def block_setting(self, block: str | None) -> Setting:
        """Return the part of a setting that chooses one of `blocks`; None leaves the choice open."""
        return {} if self.block_parameter is None or block is None else {self.block_parameter: block}

    def checked(self, setting: Setting) -> Setting:
        """Return a partial setting, with text converted to numbers. Raises CodecError for unknown names and values."""
        if unknown := sorted(set(setting) - set(self.parameters)):
            raise CodecError(f"{self.name} has no parameter {unknown[0]}; choose from {', '.join(self.parameters)}")
        return {name: self.parameters[name].checked(name, value) for name, value in setting.items()}

    def leaves_open(self, setting: Setting) -> bool:
        """Return whether a setting leaves out a parameter that the first curve of rate points varies."""
        return any(name not in setting for rate_point in self.rate_points for name in rate_point)

    def complete(self, setting: Setting) -> Setting:
        """Return a setting, checked, with the defaults of the parameters that it leaves out.

        Raises:
            CodecError: There is no such parameter, or it cannot have that value.
        """
        defaults = {name: parameter.default for name, parameter in self.parameters.items()}
        return {**defaults, **self.checked(setting)}

    def live(self, setting: Setting, signal_format: SignalFormat, model: Model | None) -> Setting:
        """Return a setting, completed for a live stream of the least delay. Raises CodecError as `complete`."""
        complete = self.complete(setting)
        if self.resolve is None or AUTO not in complete.values():
            return complete
        return chosen(complete, self.resolve(None, signal_format, model, complete))


def chosen(setting: Setting, choice: Setting) -> Setting:
    """Return a setting with a choice in place of what is "auto"."""
    return {name: choice[name] if value == AUTO else value for name, value in setting.items()}
