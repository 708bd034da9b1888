"""Coded streams in memory: their properties and their decoding. device_protocol/coded_stream.py has their bytes."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from vibrocast import models, textures
from vibrocast.codec.interface import Codec, CodecError, Decoded, Decoder, Setting, Signal
from vibrocast.codec.registry import codec_by_identifier
from vibrocast.codec.threshold import FeltError
from vibrocast.device_protocol import coded_stream
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.files import atomic_write, read_input
from vibrocast.memory import shortage
from vibrocast.textures import arguments

MAX_SAMPLES = 2**29
"""Most samples of all channels together in one stream: 53 hours of one channel at 2800 Hz, 5 GiB while decoded."""

MAX_FILE_BYTES = 2**30
MAX_GAIN_DB = 400
"""Largest change of a level, up or down; a larger one is a mistake."""
MAX_GAIN = 2.0**127
_MIN_GAIN = 2.0**-120


@dataclass(frozen=True, kw_only=True)
class CodingQuality:
    """How near a stream comes to the recording and to the target.

    Attributes:
        snr_db: Mean SNR of the channels in dB; None for silence, and where nothing was lost.
        snr_db_per_channel: The same of each channel.
        skin_snr_db: SNR of the displacement that the samples stand for, 20 to 1000 Hz, in dB; None without a unit.
        weighted_skin_snr_db: The same, with each frequency weighted by the threshold of touch.
        note: Why the target was missed; None where it was met.
        highpass_hz: Corner of the high-pass before coding in Hz; None where the whole band was coded.
        removed_below: Part of the recording's energy below `highpass_hz`, 0 to 1.
        lowpass_hz: Half the stream's rate in Hz; None where the recording has no more.
        removed_above: Part of the other energy that lay above, 0 to 1.
        felt_error: Where the error is felt most; None without a unit, and for an exact copy.
    """

    snr_db: float | None
    snr_db_per_channel: tuple[float | None, ...]
    skin_snr_db: float | None = None
    weighted_skin_snr_db: float | None = None
    note: str | None = None
    highpass_hz: float | None = None
    removed_below: float = 0.0
    lowpass_hz: float | None = None
    removed_above: float = 0.0
    felt_error: FeltError | None = None


@dataclass(frozen=True)
class Stream:
    """A coded stream in memory: the content of a .vct file, with the model image that it needs.

    Attributes:
        header: Codec, rate in Hz, unit, gains and length.
        packets: The bytes of each packet.
        image: The packed model image; None without one.
        runtime: "core" or "onnx": the decoder, where the model leaves the choice. None: as the image says.
        quality: The quality of a stream just encoded; a file does not store it.
        setting: The complete setting by which it was just coded; None in a file.
        squared_errors: The squared error of each channel relative to full scale, by the encoder; None where it cannot
            tell, and in a file.

    Raises:
        CodecError: The codec is unknown, or the image is another.
        StreamError: The packets do not hold the samples of the header.
    """

    header: StreamHeader
    packets: tuple[bytes, ...]
    image: bytes | None = None
    runtime: str | None = None
    quality: CodingQuality | None = field(default=None, compare=False, repr=False)
    setting: Setting | None = field(default=None, compare=False, repr=False)
    squared_errors: tuple[float, ...] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.image is not None and image_hash(self.image) != self.header.image_hash:
            raise CodecError(
                "the stream was not coded for this model image",
                action="leave out `model`, or give the right one",
                parameter="model",
            )
        if not self.packets or self.samples < 1:
            raise StreamError("it holds no signal; encode the recording again")
        needed = -(-(self.samples + self.delay_samples) // self.packet_samples)
        if len(self.packets) != needed:
            flaw = "it is cut short" if len(self.packets) < needed else "it has surplus packets"
            raise StreamError(f"{flaw}: {len(self.packets)} instead of {needed}; copy the file again")
        check_length(self.samples * self.header.channels)

    def __bytes__(self) -> bytes:
        """Return the bytes of the .vct file."""
        return coded_stream.pack_file(self.header, self.packets)

    @classmethod
    def from_bytes(cls, data: bytes, image: bytes | None = None) -> Self:
        """Read the bytes of a .vct file.

        Args:
            data: The bytes.
            image: The packed model image that the stream was coded for. None: a model that ships.

        Raises:
            StreamError: The bytes are damaged.
            CodecError: The codec is unknown, or the image is another.
        """
        if not isinstance(data, bytes | bytearray | memoryview):
            raise arguments.wrong_type("data", data, "the bytes of a .vct file")
        header, packets = coded_stream.unpack_file(bytes(data))
        return cls(header, tuple(packets), shipped_image(header) if image is None else image)

    def save(self, path: str | Path) -> None:
        """Write a .vct file, whole or not at all.

        Raises:
            OSError: The file cannot be written.
        """
        with atomic_write(arguments.file_path("path", path)) as partial:
            partial.write_bytes(bytes(self))

    @cached_property
    def size_bytes(self) -> int:
        """The size of the whole .vct file in bytes."""
        return len(bytes(self))

    @property
    def samples(self) -> int:
        """The samples per channel; those of all packets where the header leaves the length open."""
        if self.header.samples is not None:
            return self.header.samples
        return len(self.packets) * self.packet_samples - self.delay_samples

    @property
    def seconds(self) -> float:
        """The duration in s; of a height profile, its length in metres."""
        return self.samples / self.header.rate_hz

    @property
    def bits_per_second(self) -> float:
        """The bits of the whole .vct file over `seconds`."""
        return 8 * self.size_bytes / self.seconds

    @property
    def packet_samples(self) -> int:
        """The samples per channel in every packet."""
        return self._layout[0]

    @property
    def delay_samples(self) -> int:
        """The samples per channel by which what a decoder returns lags the signal."""
        return self._layout[1]

    @cached_property
    def _layout(self) -> tuple[int, int]:
        """The samples of packets and of the delay, also of a stream whose image is not here. Raises CodecError."""
        made = self._decoder(self.header, self.tables if self.codec.needs_model else None)
        return made.packet_samples, made.delay_samples

    @cached_property
    def codec(self) -> Codec:
        """The codec."""
        return codec_by_identifier(self.header.codec_identifier, self.header.configuration)

    def _decoder(self, header: StreamHeader, tables: bytes | None) -> Decoder:
        return self.codec.decoder(header.configuration, header.channels, tables, self.runtime)

    @property
    def codec_name(self) -> str:
        """The name of the codec."""
        return self.codec.name

    @property
    def model_name(self) -> str | None:
        """The name of the model image; None where there is none, or it is not here."""
        return None if self.image is None else ModelImage.unpack(self.image).name

    @property
    def tables(self) -> bytes | None:
        """The tables of the model that the codec decodes with; None for built-in ones.

        Raises:
            CodecError: They are in a model image that is not here.
        """
        if self.image is not None:
            return ModelImage.unpack(self.image).payload
        if self.header.image_hash:
            raise CodecError(
                f"the stream was coded for the model image {self.header.image_hash.hex()}, which does not ship",
                action="give its folder or its file as `model`",
                parameter="model",
            )
        return None

    def decoder(self) -> Decoder:
        """Return a new decoder of the packets.

        Raises:
            CodecError: The codec is unknown, or it needs an image that is not here.
        """
        return self._decoder(self.header, self.tables)

    def decode_integers(self, progress: Callable[[float], None] | None = None) -> Decoded:
        """Decode to the integers that a controller computes.

        Args:
            progress: Function to call with the part that is done, from 0 to 1.

        Returns:
            int16 (packets * packet_samples, channels), with the codec's delay.

        Raises:
            CodecError: The codec is unknown, or it needs an image that is not here.
            StreamError: There is not enough memory.
        """
        header = self.header
        if lack := shortage(8 * self.samples * header.channels):
            raise StreamError(f"decoding {self.samples} samples {lack}")
        decoder = self.decoder()
        decoded = np.empty((len(self.packets), decoder.packet_samples, decoder.channels), dtype=np.int16)
        for number, packet in enumerate(self.packets):
            decoded[number] = decoder.decode(packet)
            if progress is not None:
                progress((number + 1) / len(self.packets))
        return decoded.reshape(-1, decoder.channels)

    def decode(self, progress: Callable[[float], None] | None = None) -> Signal:
        """Decode to samples, with the codec's delay removed.

        Args:
            progress: Function to call with the part that is done, from 0 to 1.

        Returns:
            float64 (samples, channels) in the header's unit.

        Raises:
            CodecError: The codec is unknown, or it needs an image that is not here.
            StreamError: There is not enough memory.
        """
        integers = self.decode_integers(progress)[self.delay_samples : self.delay_samples + self.samples]
        return integers * (np.array(self.header.gains) / 32768)

    def recording(self, name: str = "decoded", progress: Callable[[float], None] | None = None) -> textures.Recording:
        """Decode to a Recording.

        Raises:
            StreamError: The stream is a height profile.
            CodecError: The codec is unknown, or it needs an image that is not here.
        """
        if self.header.spatial:
            raise StreamError("a height profile has no time; decode it with `Stream.profile`, or into a CSV file")
        return textures.Recording(self.decode(progress), self.header.rate_hz, self.header.unit, name)

    def profile(self, name: str = "decoded", progress: Callable[[float], None] | None = None) -> textures.Profile:
        """Decode a spatial stream to a Profile.

        Raises:
            StreamError: The stream is no height profile, or has several channels.
            CodecError: The codec is unknown, or it needs an image that is not here.
        """
        if not self.header.spatial or self.header.channels != 1:
            raise StreamError(
                "it is no height profile of one channel; decode it with `Stream.recording`, or into a WAV file"
            )
        return textures.Profile(self.decode(progress)[:, 0], 1e6 / self.header.rate_hz, name)

    def with_gain(self, gain_db: float) -> "Stream":
        """Return the stream at another level, exact to 0.03 dB, because full scales have 8 significant bits.

        Args:
            gain_db: Change of level in dB, -400 to 400.

        Raises:
            CodecError: No stream has that level.
        """
        return self if gain_db == 0 else replace(self, header=with_gain(self.header, gain_db))

    def repacked(self, packet_samples: int, packet_bytes: int = coded_stream.MAX_PACKET_BYTES) -> "Stream":
        """Return the stream in shorter packets, without quantising it again.

        The spectra stay the same. Only the signs of noise filling differ, which the number of a packet seeds.

        Args:
            packet_samples: Most samples per channel in a packet.
            packet_bytes: Most bytes in a packet.

        Returns:
            The stream itself where its packets are no longer.

        Raises:
            CodecError: The codec cannot split its packets, or not so far.
            StreamError: The packets are damaged.
        """
        stream = self
        longest = min(packet_samples, self.packet_samples)
        while stream.packet_samples > longest or max(map(len, stream.packets)) > packet_bytes:
            if stream is not self:
                longest = stream.packet_samples // 2
            stream = self._split(longest)
        return stream

    def _split(self, packet_samples: int) -> "Stream":
        """Return the stream in packets of at most `packet_samples` per channel. Raises as `repacked`."""
        if self.codec.repack is None:
            raise CodecError(f"the packets of the codec {self.codec.name} cannot be split; encode the recording again")
        configuration, packets = self.codec.repack(
            self.header.configuration, self.header.channels, self.tables, self.packets, packet_samples
        )
        header = replace(self.header, configuration=configuration)
        decoder = self._decoder(header, self.tables)
        end = None if header.samples is None else -(-(header.samples + decoder.delay_samples) // decoder.packet_samples)
        return replace(self, header=header, packets=tuple(packets[:end]))

    def facts(self) -> dict[str, Any]:
        """Return properties of the stream as a dictionary, ready for JSON: codec, sizes, rates, packets, model.

        Raises:
            CodecError: The codec is unknown.
        """
        refreshes = sum(refresh for _, refresh in map(coded_stream.packet_sequence, self.packets))
        facts = {
            "codec": self.codec_name,
            "rate_hz": self.header.rate_hz,
            "channels": self.header.channels,
            "unit": self.header.unit,
            "full_scale": list(self.header.gains),
            "samples": self.samples,
            "seconds": self.seconds,
            "size_bytes": self.size_bytes,
            "bits_per_second": self.bits_per_second,
            "bits_per_sample": self.bits_per_second / self.header.rate_hz / self.header.channels,
            "packets": len(self.packets),
            "random_access_packets": refreshes,
            "packet_samples": self.packet_samples,
            "largest_packet_bytes": max(map(len, self.packets), default=0),
            "delay_samples": self.delay_samples,
            "model": self.model_name,
            "model_image": self.header.image_hash.hex() or None,
        }
        if not self.header.spatial:
            return facts
        facts["length_mm"] = 1000 * self.seconds
        facts["bits_per_mm"] = self.bits_per_second / 1000
        spatial_names = {"rate_hz": "samples_per_metre"}
        over_time = ("seconds", "bits_per_second")
        return {spatial_names.get(name, name): value for name, value in facts.items() if name not in over_time}


def gain_for(peak: float) -> float:
    """Return the smallest number of 8 significant bits that is not below `peak`; 1 for silence.

    Raises CodecError outside 2^-120 to 2^127.
    """
    if peak == 0:
        return 1.0
    if not _MIN_GAIN <= peak <= MAX_GAIN:
        raise CodecError(f"the signal's peak {peak:g} is outside {_MIN_GAIN:.0e} to {MAX_GAIN:.0e}; use another unit")
    mantissa, exponent = math.frexp(peak)
    return math.ldexp(math.ceil(mantissa * 256), exponent - 8)


def nearest_gain(gain: float) -> float:
    """Return the number of 8 significant bits that is nearest. Raises CodecError as `gain_for`."""
    mantissa, exponent = math.frexp(gain)
    return gain_for(math.ldexp(round(mantissa * 256), exponent - 8))


def with_gain(header: StreamHeader, gain_db: float) -> StreamHeader:
    """Return the header of a stream at another level, as `Stream.with_gain` says. Raises CodecError."""
    if gain_db == 0:
        return header
    beyond = CodecError(
        f"`gain_db`={gain_db:g}", "beyond any level of a stream", "give a number nearer to 0", parameter="gain_db"
    )
    if not abs(gain_db) <= MAX_GAIN_DB:
        raise beyond
    factor = 10 ** (gain_db / 20)
    try:
        return replace(header, gains=tuple(nearest_gain(gain * factor) for gain in header.gains))
    except CodecError as error:
        raise beyond from error


def shipped_image(header: StreamHeader) -> bytes | None:
    """Return the packed model image that a stream was coded for, if it ships; None without one."""
    model = models.by_hash(header.image_hash) if header.image_hash else None
    return None if model is None else model.image


def image_hash(image: bytes) -> bytes:
    """Return the bytes by which a stream's header names a packed model image."""
    return sha256(image)[: coded_stream.IMAGE_HASH_BYTES]


def check_length(samples: int) -> None:
    """Raise StreamError if a stream cannot hold so long a signal; `samples` counts all channels."""
    if samples > MAX_SAMPLES:
        raise StreamError(
            f"{samples} samples in all channels, and a stream holds at most {MAX_SAMPLES}; cut the recording into parts"
        )


def read_stream(path: Path, image: bytes | None = None) -> Stream:
    """Read a .vct file. `image`: its packed model image; None = the built-in tables, or an image that ships.

    Raises InputError when it is no such file, StreamError when it is damaged, CodecError for another image or
    codec, OSError when it cannot be read.
    """
    data = read_input(path, "coded stream (.vct file)", b"", MAX_FILE_BYTES)
    try:
        return Stream.from_bytes(data, image)
    except StreamError as error:
        raise StreamError(f"{path}: {error}") from error


def write_profile(path: Path, stream: Stream, progress: Callable[[float], None] | None = None) -> textures.Profile:
    """Decode a spatial stream into a CSV file of position_um and height_um; return the profile.

    `progress` as in `Stream.decode`. Raises StreamError for any other stream or several channels, CodecError, OSError.
    """
    profile = stream.profile(path.stem, progress)
    with atomic_write(path) as partial:
        textures.save_profile(partial, profile)
    return profile


def write_recording(path: Path, stream: Stream, progress: Callable[[float], None] | None = None) -> float:
    """Decode a stream into a file of any format that `textures.save` writes; return its full scale, as `save` does.

    `progress` as in `Stream.decode`. Raises StreamError for a height profile, CodecError, TextureError or OSError.
    """
    recording = stream.recording(path.stem, progress)
    with atomic_write(path) as partial:
        try:
            return textures.save(partial, recording)
        except textures.TextureError as error:
            # The message names the partial file.
            raise textures.TextureError(str(error).replace(str(partial), str(path))) from error
