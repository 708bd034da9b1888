"""Codecs of other packages: classes that need only NumPy, found through the entry point group `vibrocast.codecs`."""

import struct
from collections.abc import Mapping, Sequence
from importlib.metadata import EntryPoints, entry_points
from typing import Any, Protocol, runtime_checkable

import numpy as np

from vibrocast.codec.core import PacketwiseEncoder, faded_backwards
from vibrocast.codec.interface import (
    Codec,
    CodecError,
    Decoded,
    Framing,
    Parameter,
    RatePoints,
    Signal,
    check_channels,
    number,
)
from vibrocast.device_protocol.layout import pack_varint

GROUP = "vibrocast.codecs"
IDENTIFIER = 15
"""Number in stream headers that all codecs of other packages share; the codec's configuration holds the name."""
MAX_PACKET_SAMPLES = 1 << 16
_MAX_NAME_BYTES = 64
_CONFIGURATION = struct.Struct("<dI")
_FADE_SAMPLES = 32


@runtime_checkable
class BlockCodec(Protocol):
    """A codec of your own: its packets stand alone. Register the class or an object of it."""

    # Properties, so that a type checker accepts attributes of narrower types, such as a range.
    @property
    def name(self) -> str:
        """The name of the codec, as in `--codec`."""

    @property
    def summary(self) -> str:
        """One line for `vibrocast codecs`."""

    @property
    def block_samples(self) -> int:
        """The samples of a block. A packet holds whole blocks."""

    @property
    def qualities(self) -> Sequence[float]:
        """Values of the parameter `quality`, from the fewest bits to the best.

        A search for an SNR or a rate tries them and values between.
        """

    def encode(self, samples: Signal, quality: float) -> bytes:
        """Encode one packet.

        Args:
            samples: float64 (n, channels) within -1 to 1. Never modify it.
            quality: One of `qualities`, or a value between two.

        Returns:
            The bytes of the packet.
        """

    def decode(self, data: bytes, samples: int, channels: int, quality: float) -> Signal:
        """Decode one packet.

        Args:
            data: What `encode` returned.
            samples: The samples per channel.
            channels: The number of channels.
            quality: As for `encode`.

        Returns:
            float64 (samples, channels).

        Raises:
            ValueError: The bytes are damaged.
        """


def registered() -> EntryPoints:
    """Return the entry points of the installed packages."""
    return entry_points(group=GROUP)


def load(built_in: Mapping[str, Codec]) -> tuple[dict[str, Codec], dict[str, str]]:
    """Return the codecs of installed packages by name, and the errors of the others by their entry point."""
    codecs: dict[str, Codec] = {}
    failures: dict[str, str] = {}
    for point in registered():
        try:
            codec = as_codec(point.load())
            if codec.name in built_in or codec.name in codecs:
                raise CodecError(f"there is a codec {codec.name} already; rename it")
            codecs[codec.name] = codec
        except Exception as error:  # whatever another package raises, the other codecs stay usable
            failures[point.name] = f"{point.value}: {type(error).__name__}: {error}"
    return codecs, failures


def as_codec(found: object) -> Codec:
    """Return a BlockCodec, its class or a Codec as a Codec. Raises CodecError if a part is missing."""
    if isinstance(found, Codec):
        return found
    try:
        plugin = found() if isinstance(found, type) else found
    except Exception as error:
        raise CodecError(f"its class cannot be called without arguments: {type(error).__name__}: {error}") from error
    if not isinstance(plugin, BlockCodec):
        raise CodecError(
            "it lacks name, summary, block_samples, qualities, encode or decode; see docs/how-to/add_a_codec.md"
        )
    return adapted(plugin)


def adapted(plugin: BlockCodec) -> Codec:
    """Return the Codec that wraps a BlockCodec of another package. Raises CodecError if a part is missing."""
    name = plugin.name
    try:
        qualities = [float(quality) for quality in plugin.qualities]
    except (TypeError, ValueError):
        qualities = []
    if not (isinstance(name, str) and name.isprintable() and 1 <= len(name.encode()) <= _MAX_NAME_BYTES):
        raise CodecError(f"its name must be 1 to {_MAX_NAME_BYTES} bytes of printable text")
    if not qualities or not np.all(np.isfinite(qualities)):
        raise CodecError("its qualities must be finite numbers, at least one")
    if not (isinstance(plugin.block_samples, int) and 1 <= plugin.block_samples <= MAX_PACKET_SAMPLES):
        raise CodecError(
            f"its block_samples is {plugin.block_samples}; it must be an integer of 1 to {MAX_PACKET_SAMPLES}"
        )

    middle = qualities[len(qualities) // 2]
    quality = Parameter("quality; more is better", middle, low=min(qualities), high=max(qualities))
    return Codec(
        name=name,
        identifier=IDENTIFIER,
        summary=plugin.summary,
        parameters={"quality": quality},
        rate_point_sets={name: RatePoints(tuple({"quality": quality} for quality in qualities))},
        make_encoder=lambda setting, signal_format, framing, model, rate_control: PluginEncoder(
            plugin, number(setting, "quality"), signal_format.channels, framing
        ),
        make_decoder=lambda configuration, channels, tables: PluginDecoder(plugin, configuration, channels),
    )


def name_in(configuration: bytes) -> str:
    """Return the name of another package's codec in its configuration. Raises CodecError on damaged bytes."""
    name = configuration[1 : 1 + configuration[0]] if configuration else b""
    try:
        text = name.decode()
    except UnicodeDecodeError:
        text = ""
    if not text or len(configuration) != 1 + len(name) + _CONFIGURATION.size:
        raise CodecError("the codec configuration is damaged or of another version; encode the recording again")
    return text


class PluginEncoder(PacketwiseEncoder):
    """Encoder of another package's codec; see codec.interface.Encoder."""

    def __init__(self, plugin: BlockCodec, quality: float, channels: int, framing: Framing) -> None:
        """Make an encoder. Raises CodecError for packets that are too long."""
        block = plugin.block_samples
        super().__init__(channels, framing, block, MAX_PACKET_SAMPLES // block)
        name = plugin.name.encode()
        self.configuration = bytes((len(name),)) + name + _CONFIGURATION.pack(quality, self.packet_samples)
        self._plugin, self._quality = plugin, quality
        self._sequence = 0

    def _code_packets(self, samples: Signal) -> list[bytes]:
        return [self._packet_of(part) for part in np.split(samples, len(samples) // self.packet_samples)]

    def _packet_of(self, samples: Signal) -> bytes:
        try:
            coded = bytes(self._plugin.encode(samples, self._quality))
        except Exception as error:
            raise CodecError(f"the codec {self._plugin.name} failed: {type(error).__name__}: {error}") from error
        # Every packet is a refresh: bit 0.
        head = pack_varint(2 * self._sequence + 1)
        self._sequence += 1
        return head + coded


class PluginDecoder:
    """Decoder of another package's codec; see codec.interface.Decoder."""

    delay_samples = 0
    hosts_only = False

    def __init__(self, plugin: BlockCodec, configuration: bytes, channels: int) -> None:
        """Make a decoder from the codec's bytes in the stream header. Raises CodecError when they are not valid."""
        check_channels(channels)
        name_in(configuration)
        self._plugin, self.channels = plugin, channels
        self._quality, self.packet_samples = _CONFIGURATION.unpack(configuration[-_CONFIGURATION.size :])
        if not (1 <= self.packet_samples <= MAX_PACKET_SAMPLES and np.isfinite(self._quality)):
            raise CodecError("the codec configuration is damaged or of another version; encode the recording again")
        self._last: Decoded = np.zeros((self.packet_samples, channels), dtype=np.int16)

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels). Raises CodecError on a malformed packet."""
        head = next((index for index, byte in enumerate(packet) if byte < 0x80), None)
        if head is None:
            raise CodecError("a packet is cut short; copy or encode the stream again")
        samples, channels = self.packet_samples, self.channels
        try:
            decoded: Any = np.asarray(self._plugin.decode(packet[head + 1 :], samples, channels, self._quality))
            usable = decoded.shape == (samples, channels) and bool(np.all(np.isfinite(decoded)))
        except Exception as error:
            raise CodecError(f"the codec {self._plugin.name} failed: {type(error).__name__}: {error}") from error
        if not usable:
            raise CodecError(
                f"the codec {self._plugin.name} did not return finite numbers ({samples}, {channels}); "
                "correct its decode"
            )
        self._last = np.clip(np.rint(decoded * 32768), -32768, 32767).astype(np.int16)
        return self._last

    def conceal(self) -> Decoded:
        """Replace one missing packet: the last sound, backwards and faded out, then silence."""
        samples = faded_backwards(self._last, _FADE_SAMPLES)
        self._last = np.zeros_like(self._last)
        return samples
