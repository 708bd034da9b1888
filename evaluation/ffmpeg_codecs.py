"""Codecs of FFmpeg's libraries, peers of the benchmark: Opus, AMR-NB, G.723.1, G.726, WavPack and FLAC through PyAV.

No controller decodes them, so a decoder expects every packet.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import extras
from vibrocast.codec.interface import (
    Codec,
    CodecError,
    Decoded,
    Framing,
    Parameter,
    RatePoints,
    Setting,
    Signal,
    check_channels,
    checked_parts,
    number,
    word,
)
from vibrocast.device_protocol.layout import Reader, pack_varint

_LABEL_HZ = 8000
"""The rate with which samples of every stream are labelled: speech codecs have no other, the rest ignore it."""
_MAX_PACKET_SAMPLES = 65_535
_MAX_SEQUENCE_BITS = 33
_FIELD_BITS = 16
_CHUNK_SAMPLES = 1 << 18
_AMR_BITS_PER_SECOND = (4750, 5150, 5900, 6700, 7400, 7950, 10_200, 12_200)
# 3GPP TS 26.101, annex A: a byte of header, then the speech bits of the mode.
_AMR_FRAME_BYTES = (13, 14, 16, 18, 20, 21, 27, 32)
# At full amplitude G.726's coarse quantiser saturates, which costs up to 7 dB of SNR; so the signal is halved.
_G726_FULL_SCALE_BITS = 15
_OPUS_FRAMES_SAMPLES = (20, 40, 80, 160, 320, 480)
_OPUS_BITS_PER_SECOND = (6000, 8000, 10_000, 12_000, 16_000, 20_000, 24_000, 32_000, 48_000, 64_000)
_WAVPACK_BITS_PER_SAMPLE = (3, 4, 5, 6, 7, 8, 10, 12, 14, 16)


@dataclass(frozen=True)
class Plan:
    """How a codec codes with one setting.

    `frame_samples`: samples in a codec frame. `delay_samples`: lag of the decoded signal. `options`: of libav's
    encoder. `frame_bytes`: bytes in every codec frame, 0 if they differ. `bits_per_sample`: bits kept of each sample
    before coding.
    """

    frame_samples: int
    delay_samples: int
    options: Mapping[str, str]
    frame_bytes: int = 0
    bits_per_sample: int = 16


@dataclass(frozen=True)
class Library:
    """The name of libav's encoder and decoder of a codec, and how they differ from the others.

    `plan(setting, packet_samples)`. `decimation`: keep every n-th decoded sample. `continuous`: frames of eight samples
    have no bounds, so those of a packet are decoded at once. `full_scale_bits`: 16, or fewer if the codec needs
    headroom.
    """

    name: str
    plan: Callable[[Setting, int], Plan]
    sample_format: str = "s16"
    decimation: int = 1
    continuous: bool = False
    full_scale_bits: int = 16


class LibavEncoder:
    """Encoder of all these codecs; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(self, library: Library, plan: Plan, framing: Framing, channels: int) -> None:
        """Make an encoder; it codes each channel alone, and all of it at the end.

        Raises CodecError for a channel count or packet length that a stream cannot have, or if libav is missing.
        """
        check_channels(channels)
        self._library, self._plan = library, plan
        self._packet_frames = -(-framing.packet_samples // plan.frame_samples)
        self.packet_samples = self._packet_frames * plan.frame_samples
        self.delay_samples = plan.delay_samples
        if not 1 <= self.packet_samples <= _MAX_PACKET_SAMPLES:
            raise CodecError(
                f"packets of {framing.packet_samples} samples are not possible; give 1 to {_MAX_PACKET_SAMPLES}"
            )
        fields = (plan.delay_samples, plan.frame_samples, self._packet_frames, plan.frame_bytes)
        self.configuration = b"".join(map(pack_varint, fields))
        self._contexts = [_open(library.name, "w", plan.options, library.sample_format) for _ in range(channels)]
        self._taken: list[NDArray[np.int16]] = []

    def encode(self, samples: Signal) -> list[bytes]:
        """Take samples (n, channels), return no packet yet. Raises CodecError on NaN, infinity or a wrong shape."""
        levels = 2 ** (self._plan.bits_per_sample - 1)
        for part in checked_parts(samples, len(self._contexts), _CHUNK_SAMPLES):
            rounded = np.minimum(np.rint(part * levels), levels - 1).astype(np.int16)
            self._taken.append(rounded << (self._library.full_scale_bits - self._plan.bits_per_sample))
        return []

    def finish(self) -> list[bytes]:
        """Pad with zeros and return all packets; the last has no more frames than needed."""
        if not self._taken:
            return []
        taken = np.concatenate(self._taken)
        self._taken = []
        frames = -(-(len(taken) + self.delay_samples) // self._plan.frame_samples)
        padded = np.pad(taken, ((0, frames * self._plan.frame_samples - len(taken)), (0, 0)))
        coded = [
            list(self._coded(context, channel))[:frames]
            for context, channel in zip(self._contexts, padded.T, strict=True)
        ]
        packets: list[bytes] = []
        for start in range(0, frames, self._packet_frames):
            own = [frame for channel in coded for frame in channel[start : start + self._packet_frames]]
            lengths = [b"" if self._plan.frame_bytes else pack_varint(len(frame)) for frame in own]
            head = pack_varint(2 * len(packets) + 1)
            packets.append(head + b"".join(part for pair in zip(lengths, own, strict=True) for part in pair))
        return packets

    def _coded(self, context: Any, samples: NDArray[np.int16]) -> Iterator[bytes]:
        """Yield the codec frames of a channel (n,)."""
        parts = [samples[start : start + context.frame_size] for start in range(0, len(samples), context.frame_size)]
        for part in [*parts, None]:  # at the end, libav gives what it holds back
            frame = None
            if part is not None:
                frame = _av().AudioFrame.from_ndarray(
                    np.ascontiguousarray(part[None]), format=self._library.sample_format, layout="mono"
                )
                frame.sample_rate = _LABEL_HZ
            for packet in map(bytes, context.encode(frame)):
                size = self._plan.frame_bytes or len(packet)
                yield from (packet[start : start + size] for start in range(0, len(packet), size or 1))


class LibavDecoder:
    """Decoder of all these codecs; see codec.interface.Decoder. It takes what the encoder has just made."""

    hosts_only = False

    def __init__(self, library: Library, configuration: bytes, channels: int) -> None:
        """Make a decoder from the encoder's configuration. Raises CodecError if libav is missing."""
        self._library = library
        self.channels = channels
        reader = Reader(configuration, CodecError)
        self.delay_samples, self._frame_samples, packet_frames, self._frame_bytes = (
            reader.varint(_FIELD_BITS) for _ in range(4)
        )
        self.packet_samples = packet_frames * self._frame_samples
        options = {"bits_per_coded_sample": str(self._frame_bytes)} if library.continuous else {}
        self._contexts = [_open(library.name, "r", options) for _ in range(channels)]

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels); silence follows the frames of a shorter one."""
        reader = Reader(packet, CodecError)
        reader.varint(_MAX_SEQUENCE_BITS)
        frames: list[bytes] = []  # all of one channel before those of the next
        while not reader.at_end:
            frames.append(reader.take(self._frame_bytes or reader.varint(_FIELD_BITS)))
        count = len(frames) // self.channels
        samples = np.zeros((self.packet_samples, self.channels), dtype=np.int16)
        scale = 2 ** (16 - self._library.full_scale_bits)
        for channel, context in enumerate(self._contexts):
            own = frames[channel * count : (channel + 1) * count]
            if self._library.continuous:
                own = [b"".join(own)]
            parts = [part.to_ndarray().ravel() for frame in own for part in context.decode(_av().Packet(frame))]
            kept = np.concatenate(parts)[:: self._library.decimation]
            samples[: len(kept), channel] = np.clip(kept.astype(np.int32) * scale, -32_768, 32_767)
        return samples

    def conceal(self) -> Decoded:
        """Replace one missing packet: silence."""
        return np.zeros((self.packet_samples, self.channels), dtype=np.int16)


def _av() -> Any:
    """Return the package `av`, imported on first use because that is slow. Raises CodecError."""
    if advice := extras.advice("peers"):
        raise CodecError(advice)
    try:
        import av
    except ImportError as error:
        raise CodecError(
            f"this codec needs the package av, which cannot be imported ({error}); install it again"
        ) from error
    return av


def _open(name: str, mode: str, options: Mapping[str, str], sample_format: str | None = None) -> Any:
    """Return an open libav context of one channel. Raises CodecError if this build lacks the codec."""
    av = _av()
    try:
        context = av.CodecContext.create(name, mode)
        context.sample_rate = _LABEL_HZ
        context.layout = "mono"
        if sample_format:
            context.format = sample_format
        context.options = dict(options)
        context.thread_count = 1
        context.open()
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(f"FFmpeg's codec {name} cannot be opened here ({error}); install PyAV's own wheel") from error
    return context


def _plan_opus(setting: Setting, packet_samples: int) -> Plan:
    frame_samples = int(word(setting, "frame_samples"))
    options = {
        "b": str(number(setting, "bit_rate_bps")),
        "frame_duration": str(1000 * frame_samples / _LABEL_HZ),
        # Never the speech coder: at the 48 kHz at which libav decodes, its delay is 0.7 of our samples longer.
        "application": "lowdelay",
        "vbr": "constrained",  # libopus's own default; FFmpeg's lets the rate drift far from the setting
    }
    return Plan(frame_samples, 20, options)


def _plan_amr(setting: Setting, packet_samples: int) -> Plan:
    mode = int(number(setting, "mode"))
    return Plan(160, 40, {"b": str(_AMR_BITS_PER_SECOND[mode])}, _AMR_FRAME_BYTES[mode])


def _plan_g726(setting: Setting, packet_samples: int) -> Plan:
    bits = int(number(setting, "bits_per_sample"))
    # Eight samples fill whole bytes.
    return Plan(8, 0, {"code_size": str(bits)}, bits, _G726_FULL_SCALE_BITS)


def _plan_wavpack(setting: Setting, packet_samples: int) -> Plan:
    frame_samples = max(128, packet_samples)
    options = {"frame_size": str(frame_samples), "compression_level": "4"}
    return Plan(frame_samples, 0, options, bits_per_sample=int(number(setting, "bits_per_sample")))


def _plan_flac(setting: Setting, packet_samples: int) -> Plan:
    frame_samples = max(16, packet_samples)
    return Plan(frame_samples, 0, {"frame_size": str(frame_samples), "compression_level": "8"})


def _codec(
    name: str,
    identifier: int,
    summary: str,
    library: Library,
    parameters: Mapping[str, Parameter],
    rate_point_set: tuple[Setting, ...],
) -> Codec:
    return Codec(
        name,
        identifier,
        summary,
        parameters,
        {name: RatePoints(rate_point_set)},
        make_encoder=lambda setting, signal_format, framing, *_: LibavEncoder(
            library, library.plan(setting, framing.packet_samples), framing, signal_format.channels
        ),
        make_decoder=lambda configuration, channels, _: LibavDecoder(library, configuration, channels),
    )


CODECS = (
    _codec(
        "opus",
        5,
        "Opus (RFC 6716), its low-delay MDCT coder, by libopus",
        Library("libopus", _plan_opus, decimation=6),
        {
            "bit_rate_bps": Parameter(
                "mean bit rate, in bit/s at 8000 samples/s", 16_000, low=500, high=128_000, whole=True
            ),
            "frame_samples": Parameter("samples in a frame", "160", choices=tuple(map(str, _OPUS_FRAMES_SAMPLES))),
        },
        tuple({"bit_rate_bps": rate} for rate in _OPUS_BITS_PER_SECOND),
    ),
    _codec(
        "amr-nb",
        6,
        "AMR narrow-band (3GPP TS 26.071), ACELP speech codec, by libopencore",
        Library("libopencore_amrnb", _plan_amr),
        {
            "mode": Parameter(
                "0 to 7 = 4.75, 5.15, 5.9, 6.7, 7.4, 7.95, 10.2 or 12.2 kbit/s at 8000 samples/s", 7, 0, 7, True
            )
        },
        tuple({"mode": mode} for mode in range(8)),
    ),
    _codec(
        "g723-1",
        7,
        "ITU-T G.723.1, multi-pulse speech codec of 6.3 kbit/s at 8000 samples/s",
        Library("g723_1", lambda setting, packet_samples: Plan(240, 60, {"b": "6300"}, 24)),
        {},
        ({},),
    ),
    _codec(
        "g726",
        8,
        "ITU-T G.726, adaptive differential PCM",
        Library("g726", _plan_g726, continuous=True, full_scale_bits=_G726_FULL_SCALE_BITS),
        {"bits_per_sample": Parameter("bits per coded sample", 4, low=2, high=5, whole=True)},
        tuple({"bits_per_sample": bits} for bits in range(2, 6)),
    ),
    _codec(
        "wavpack",
        9,
        "WavPack, lossless linear prediction, after rounding the samples to fewer bits",
        Library("wavpack", _plan_wavpack, sample_format="s16p"),
        {"bits_per_sample": Parameter("bits kept of each sample; 16 = lossless", 8, 2, 16, True)},
        tuple({"bits_per_sample": bits} for bits in _WAVPACK_BITS_PER_SAMPLE),
    ),
    _codec(
        "flac",
        10,
        "FLAC (RFC 9639), lossless linear prediction of the 16-bit samples",
        Library("flac", _plan_flac),
        {},
        ({},),
    ),
)
