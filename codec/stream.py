"""Coded streams in memory: what they hold and decode to. device_protocol/coded_stream.py has their bytes."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, models, textures
from vibrocast.device_protocol import coded_stream
from vibrocast.device_protocol.coded_stream import StreamError, StreamHeader
from vibrocast.device_protocol.model_image import ModelImage, sha256
from vibrocast.files import atomic_write, read_input
from vibrocast.textures import arguments
from vibrocast.textures.memory import shortage

MAX_SAMPLES = 2**29
"""Of all channels together, in one stream: 53 hours of one channel at 2800 Hz, 5 GiB while they are decoded."""

MAX_FILE_BYTES = 2**30
MAX_GAIN_DB = 400
"""Largest change of a level, up or down; a larger one is a mistake."""


@dataclass(frozen=True, kw_only=True)
class CodingQuality:
    """How near a stream comes to what was coded, and to what was asked.

    `snr_db`, as `codec.snr_db`, over all channels and of each: None for silence, or where nothing was lost.
    `tactile_snr_db`: as `codec.tactile_snr_db`. `removed_energy`: part of the given energy that lay below
    `highpass_hz` and was not coded; `highpass_hz`: None = the whole band was coded. `note`: why the asked rate or SNR
    was not met, None when it was.
    """

    snr_db: float | None
    snr_db_per_channel: tuple[float | None, ...]
    tactile_snr_db: float | None
    note: str | None = None
    highpass_hz: float | None = None
    removed_energy: float = 0.0


@dataclass(frozen=True)
class Stream:
    """A whole coded stream in memory: what a .vct file holds, and the packed model image that it needs, if any.

    `runtime`: one of codec.RUNTIMES, by which it is decoded where the model leaves the choice; None = as the image
    says. `quality`: that of a stream just encoded, which no file stores. Raises CodecError for another image or codec,
    StreamError unless the packets hold just the samples of the header.
    """

    header: StreamHeader
    packets: tuple[bytes, ...]
    image: bytes | None = None
    runtime: str | None = None
    quality: CodingQuality | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.image is not None and image_hash(self.image) != self.header.image_hash:
            raise codec.CodecError(
                "the stream was not coded for this model image; leave out `model`, or give the other"
            )
        decoder = self.decoder()
        if not self.packets or self.samples < 1:
            raise StreamError("it holds no signal; encode the recording again")
        needed = -(-(self.samples + decoder.delay_samples) // decoder.packet_samples)
        if len(self.packets) != needed:
            flaw = "it is cut short" if len(self.packets) < needed else "it has surplus packets"
            raise StreamError(f"{flaw}: {len(self.packets)} instead of {needed}; copy the file again")
        check_length(self.samples * decoder.channels)

    def __bytes__(self) -> bytes:
        """Return the bytes of the .vct file."""
        return coded_stream.pack_file(self.header, self.packets)

    @classmethod
    def from_bytes(cls, data: bytes, image: bytes | None = None) -> Self:
        """Read the bytes of a .vct file. `image`: the packed model image it was coded for; None = of one that ships.

        Raises StreamError when they are damaged, CodecError for another image or codec.
        """
        if not isinstance(data, bytes | bytearray | memoryview):
            raise StreamError(f"`data` is of type {type(data).__name__}; pass the bytes of a .vct file")
        header, packets = coded_stream.unpack_file(bytes(data))
        if image is None and header.image_hash and (model := models.by_hash(header.image_hash)):
            image = model.image
        return cls(header, tuple(packets), image)

    def save(self, path: str | Path) -> None:
        """Write a .vct file, whole or not at all. Raises OSError."""
        with atomic_write(arguments.file_path("path", path)) as partial:
            partial.write_bytes(bytes(self))

    @property
    def size_bytes(self) -> int:
        """Bytes of the whole .vct file."""
        return len(bytes(self))

    @property
    def samples(self) -> int:
        """Samples per channel; where the header leaves the length open, those of all packets. Raises CodecError."""
        if self.header.samples is not None:
            return self.header.samples
        decoder = self.decoder()
        return len(self.packets) * decoder.packet_samples - decoder.delay_samples

    @property
    def seconds(self) -> float:
        """Duration of the signal; of a profile, its length in metres. Raises CodecError."""
        return self.samples / self.header.rate_hz

    @property
    def bits_per_second(self) -> float:
        """Bits of the whole .vct file over `seconds`. Raises CodecError."""
        return 8 * self.size_bytes / self.seconds

    @property
    def codec_name(self) -> str:
        """Name of the codec. Raises CodecError when there is none of that number."""
        return codec.codec_by_identifier(self.header.codec_identifier, self.header.configuration).name

    @property
    def model_name(self) -> str | None:
        """Name of the model image, None where there is none or it is not here."""
        return None if self.image is None else ModelImage.unpack(self.image).name

    @property
    def tables(self) -> bytes | None:
        """The codec's tables, None = built in. Raises CodecError when they are in a model image that is not here."""
        if self.image is not None:
            return ModelImage.unpack(self.image).payload
        if self.header.image_hash:
            raise codec.CodecError(
                f"the stream was coded for the model image {self.header.image_hash.hex()}, which is none of those that "
                "ship; give its folder or its file as `model`"
            )
        return None

    def decoder(self) -> codec.Decoder:
        """Return a decoder, for what it says of the packets. Raises CodecError.

        Where the codec has built-in tables it has those, so that a stream whose image is not here can be looked at.
        """
        identifier, configuration = self.header.codec_identifier, self.header.configuration
        tables = self.tables if codec.codec_by_identifier(identifier, configuration).needs_model else None
        return codec.decoder(identifier, configuration, self.header.channels, tables, self.runtime)

    def decode_integers(self, progress: Callable[[float], None] | None = None) -> NDArray[np.int16]:
        """Return what a controller decodes: int16 (packets * packet_samples, channels).

        `progress` is called with the part done, from 0 to 1. Raises CodecError, and StreamError where memory lacks.
        """
        header = self.header
        # As integers and, when all are there, as float64 in the header's unit.
        if lack := shortage(self.samples * header.channels * (2 + 8)):
            raise StreamError(f"decoding {self.samples} samples {lack}")
        decoder = codec.decoder(
            header.codec_identifier, header.configuration, header.channels, self.tables, self.runtime
        )
        decoded = np.empty((len(self.packets), decoder.packet_samples, decoder.channels), dtype=np.int16)
        for number, packet in enumerate(self.packets):
            decoded[number] = decoder.decode(packet)
            if progress is not None:
                progress((number + 1) / len(self.packets))
        return decoded.reshape(-1, decoder.channels)

    def decode(self, progress: Callable[[float], None] | None = None) -> NDArray[np.float64]:
        """Return float64 (samples, channels) in the header's unit, the codec's delay removed.

        `progress` as in `decode_integers`. Raises as that.
        """
        start = self.decoder().delay_samples
        integers = self.decode_integers(progress)[start : start + self.samples]
        return integers * (np.array(self.header.gains) / 32768)

    def recording(self, name: str = "decoded", progress: Callable[[float], None] | None = None) -> textures.Recording:
        """Decode to a recording. `progress` as in `decode_integers`. Raises StreamError for a profile, CodecError."""
        if self.header.spatial:
            raise StreamError("a height profile has no time; decode it with `Stream.profile`, or into a CSV file")
        return textures.Recording(self.decode(progress), self.header.rate_hz, self.header.unit, name)

    def profile(self, name: str = "decoded", progress: Callable[[float], None] | None = None) -> textures.Profile:
        """Decode a spatial stream to a profile. Raises StreamError for any other or several channels, CodecError."""
        if not self.header.spatial or self.header.channels != 1:
            raise StreamError("no height profile of one channel; decode it with `Stream.recording`, or into a WAV file")
        return textures.Profile(self.decode(progress)[:, 0], 1e6 / self.header.rate_hz, name)

    def with_gain(self, gain_db: float) -> "Stream":
        """Return the stream at another level, to 0.03 dB: its full scales have 8 significant bits.

        Raises CodecError for a level that a stream cannot have.
        """
        if gain_db == 0:
            return self
        beyond = codec.CodecError(f"`gain_db`={gain_db:g}: beyond any level of a stream; give a number nearer to 0")
        if not abs(gain_db) <= MAX_GAIN_DB:
            raise beyond
        factor = 10 ** (gain_db / 20)
        try:
            gains = tuple(codec.nearest_gain(gain * factor) for gain in self.header.gains)
        except codec.CodecError as error:
            raise beyond from error
        return replace(self, header=replace(self.header, gains=gains))

    def facts(self) -> dict[str, Any]:
        """Return what a person or a program wants to know of the stream, ready for JSON. Raises CodecError."""
        decoder = self.decoder()
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
            "refresh_packets": refreshes,
            "packet_samples": decoder.packet_samples,
            "delay_samples": decoder.delay_samples,
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


def as_stream(coded: codec.CodedSignal, unit: str, image: bytes | None = None) -> Stream:
    """Return a coded signal in this unit as a stream; `image`: the packed model image that it was coded for.

    Raises StreamError where the layout cannot hold it.
    """
    header = StreamHeader(
        codec.codec_by_name(coded.codec).identifier,
        coded.rate_hz,
        coded.samples,
        unit,
        coded.gains,
        coded.configuration,
        b"" if image is None else image_hash(image),
    )
    return Stream(header, coded.packets, image)


def image_hash(image: bytes) -> bytes:
    """Return the bytes by which a stream's header names a packed model image."""
    return sha256(image)[: coded_stream.IMAGE_HASH_BYTES]


def check_length(samples: int) -> None:
    """Raise StreamError for more samples, of all channels together, than one stream holds."""
    if samples > MAX_SAMPLES:
        raise StreamError(
            f"{samples} samples in all channels, at most {MAX_SAMPLES} make one stream; cut it into parts"
        )


def read_stream(path: Path, image: bytes | None = None) -> Stream:
    """Read a .vct file, coded for the built-in tables or for a packed model image; None = of a model that ships.

    Raises InputFileError when it is no such file, StreamError when it is damaged, CodecError for another image or
    codec, OSError when it cannot be read.
    """
    data = read_input(path, "coded stream (.vct file)", coded_stream.MAGIC, MAX_FILE_BYTES)
    try:
        return Stream.from_bytes(data, image)
    except StreamError as error:
        raise StreamError(f"{path}: {error}") from error


def write_profile(path: Path, stream: Stream, progress: Callable[[float], None] | None = None) -> textures.Profile:
    """Decode a spatial stream into a CSV file of position_um and height_um; return it.

    `progress` as in `Stream.decode`. Raises StreamError for any other stream or several channels, CodecError, OSError.
    """
    profile = stream.profile(path.stem, progress)
    with atomic_write(path) as partial:
        textures.save_profile(partial, profile)
    return profile


def write_recording(
    path: Path, stream: Stream, sixteen_bit: bool = False, progress: Callable[[float], None] | None = None
) -> float:
    """Decode a stream into a file of any format that `textures.save` writes, and return its full scale as that does.

    `progress` as in `Stream.decode`. Raises StreamError for a height profile, CodecError, TextureError or OSError.
    """
    recording = stream.recording(path.stem, progress)
    with atomic_write(path) as partial:
        try:
            return textures.save(partial, recording, sixteen_bit)
        except textures.TextureError as error:
            # It names the partial file.
            raise textures.TextureError(str(error).replace(str(partial), str(path))) from error
