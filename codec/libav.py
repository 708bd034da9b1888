"""Encoder and decoder by FFmpeg's libraries (PyAV), for any codec of theirs; layout in docs/reference/bitstream.md."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import extras
from vibrocast.codec.interface import (
    CodecError,
    Decoded,
    Framing,
    Setting,
    Signal,
    check_channels,
    checked_parts,
)
from vibrocast.codec.packetwise import faded_backwards
from vibrocast.device_protocol.encoding import Reader, pack_varint

LABEL_HZ = 8000
"""The rate with which samples of every stream are labelled: speech codecs have no other, the rest ignore it."""

_MAX_PACKET_SAMPLES = 65_535
_MAX_SEQUENCE_BITS = 33
_FIELD_BITS = 16
_CHUNK_SAMPLES = 1 << 18
_FADE_SAMPLES = 256
_RISE_SAMPLES = 32


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
    """The names of libav's encoder and decoder of a codec, and how they differ from the others.

    `plan(setting, packet_samples)`. `decimation`: keep every n-th decoded sample. `continuous`: frames have no bounds,
    so those of a packet are decoded at once. `full_scale_bits`: 16, or fewer if the codec needs headroom.
    `settling_samples`: samples that a decoder needs to settle when it begins in the middle of a stream.
    `decoder_options(frame_bytes)`. `controls_rate`: as of `Codec`. `file`: as `Codec.library`.
    """

    encoder: str
    decoder: str
    plan: Callable[[Setting, int], Plan]
    sample_format: str = "s16"
    decimation: int = 1
    continuous: bool = False
    full_scale_bits: int = 16
    settling_samples: int = 640  # 80 ms at 8 kHz, the pre-roll of RFC 7845, 4.6; enough for the speech codecs too
    decoder_options: Callable[[int], Mapping[str, str]] = lambda frame_bytes: {}
    controls_rate: bool = False
    file: str = ""


class LibavEncoder:
    """Encoder of all these codecs; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(self, library: Library, plan: Plan, framing: Framing, channels: int) -> None:
        """Make an encoder; it codes each channel alone.

        Raises CodecError for a channel count or packet length that a stream cannot have, or if libav is missing.
        """
        check_channels(channels)
        self._library = library
        self._plan = plan
        self._packet_frames = -(-framing.packet_samples // plan.frame_samples)
        self.packet_samples = self._packet_frames * plan.frame_samples
        self.delay_samples = plan.delay_samples
        if not 1 <= self.packet_samples <= _MAX_PACKET_SAMPLES:
            raise CodecError(
                f"packets of {framing.packet_samples} samples are not possible; give 1 to {_MAX_PACKET_SAMPLES}"
            )
        fields = (plan.delay_samples, plan.frame_samples, self._packet_frames, plan.frame_bytes)
        self.configuration = b"".join(map(pack_varint, fields))
        self._contexts = [
            _open(library.encoder, "w", plan.options, sample_format=library.sample_format) for _ in range(channels)
        ]
        self._pending: NDArray[np.int16] = np.empty((0, channels), dtype=np.int16)
        self._frames: list[list[bytes]] = [[] for _ in range(channels)]
        self._taken_samples = 0
        self._sequence = 0

    def encode(self, samples: Signal) -> list[bytes]:
        """Take samples (n, channels), return packets completed. Raises CodecError on NaN, infinity or a wrong shape."""
        levels = 2 ** (self._plan.bits_per_sample - 1)
        for part in checked_parts(samples, len(self._contexts), _CHUNK_SAMPLES):
            self._taken_samples += len(part)
            rounded = np.minimum(np.rint(part * levels), levels - 1).astype(np.int16)
            self._code(rounded << (self._library.full_scale_bits - self._plan.bits_per_sample), ended=False)
        return self._packets(ended=False)

    def finish(self) -> list[bytes]:
        """Pad with zeros and return the remaining packets; the last has no more frames than needed."""
        if not self._taken_samples:
            return []
        frame_samples = self._plan.frame_samples
        frames = -(-(self._taken_samples + self.delay_samples) // frame_samples)
        missing = frames * frame_samples - self._taken_samples
        self._taken_samples = 0
        self._code(np.zeros((missing, len(self._contexts)), dtype=np.int16), ended=True)
        for of_channel in self._frames:
            del of_channel[frames - self._sequence * self._packet_frames :]
        return self._packets(ended=True)

    def _code(self, samples: NDArray[np.int16], ended: bool) -> None:
        """Give libav whole frames; at the end also the shorter last one, and take all that it holds back."""
        self._pending = np.concatenate([self._pending, samples])
        size = self._contexts[0].frame_size
        given = len(self._pending) if ended else len(self._pending) // size * size
        for context, channel, coded in zip(self._contexts, self._pending[:given].T, self._frames, strict=True):
            for start in range(0, given, size):
                coded += self._coded(context, channel[None, start : start + size])
            if ended:
                coded += self._coded(context, None)
        self._pending = self._pending[given:]

    def _coded(self, context: Any, samples: NDArray[np.int16] | None) -> Iterator[bytes]:
        frame = None
        if samples is not None:
            samples = np.ascontiguousarray(samples)
            frame = _av().AudioFrame.from_ndarray(samples, format=self._library.sample_format, layout="mono")
            frame.sample_rate = LABEL_HZ
        for packet in map(bytes, context.encode(frame)):
            size = self._plan.frame_bytes or len(packet)
            yield from (packet[start : start + size] for start in range(0, len(packet), size or 1))

    def _packets(self, ended: bool) -> list[bytes]:
        """Return the packets that the coded frames fill; at the end the last one may have fewer frames."""
        size = self._packet_frames
        count = len(self._frames[0]) if ended else len(self._frames[0]) // size * size
        packets = []
        for start in range(0, count, size):
            frames = [frame for coded in self._frames for frame in coded[start : start + size]]
            lengths = [b"" if self._plan.frame_bytes else pack_varint(len(frame)) for frame in frames]
            head = pack_varint(2 * self._sequence + 1)
            packets.append(head + b"".join(part for pair in zip(lengths, frames, strict=True) for part in pair))
            self._sequence += 1
        self._frames = [coded[count:] for coded in self._frames]
        return packets


class LibavDecoder:
    """Decoder of all these codecs; see codec.interface.Decoder."""

    def __init__(self, library: Library, configuration: bytes, channels: int) -> None:
        """Make a decoder from the codec's bytes in the stream header.

        Raises CodecError when they are not valid, or if libav is missing.
        """
        check_channels(channels)
        self._library = library
        self.channels = channels
        reader = Reader(configuration, _damaged)
        self.delay_samples, self._frame_samples, packet_frames, self._frame_bytes = (
            reader.varint(_FIELD_BITS) for _ in range(4)
        )
        self.packet_samples = packet_frames * self._frame_samples
        if not reader.at_end or not 1 <= self.packet_samples <= _MAX_PACKET_SAMPLES:
            raise CodecError("the codec configuration is damaged or of another version; encode the recording again")
        self._contexts: Sequence[Any] = self._fresh_contexts()
        self._next_sequence: int | None = 0
        self._samples_since_gap = library.settling_samples + _RISE_SAMPLES
        self._last: Decoded = np.zeros((self.packet_samples, channels), dtype=np.int16)

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels). Raises CodecError on a malformed packet."""
        reader = Reader(packet, _damaged)
        sequence, refresh = divmod(reader.varint(_MAX_SEQUENCE_BITS), 2)
        if sequence != self._next_sequence:
            if not refresh:
                return self.conceal()
            self._contexts = self._fresh_contexts()
            self._samples_since_gap = 0
        self._next_sequence = None
        samples = self._decode_frames(self._frames(reader))
        unsettled = self._library.settling_samples - self._samples_since_gap
        if unsettled + _RISE_SAMPLES > 0:
            rise = np.clip((np.arange(self.packet_samples) - unsettled) / _RISE_SAMPLES, 0, 1)
            samples = np.rint(samples * rise[:, None]).astype(np.int16)
        self._samples_since_gap += self.packet_samples
        self._next_sequence = sequence + 1
        self._last = samples
        return samples

    def conceal(self) -> Decoded:
        """Replace one missing packet: the last sound, backwards and faded out, then silence."""
        samples = faded_backwards(self._last, _FADE_SAMPLES)
        self._last = np.zeros_like(self._last)
        self._next_sequence = None
        return samples

    def _fresh_contexts(self) -> list[Any]:
        options = self._library.decoder_options(self._frame_bytes)
        return [_open(self._library.decoder, "r", options) for _ in range(self.channels)]

    def _frames(self, reader: Reader) -> list[bytes]:
        """Return the codec frames of a packet, all of one channel before those of the next."""
        frames: list[bytes] = []
        while not reader.at_end:
            frame_bytes = self._frame_bytes or reader.varint(_FIELD_BITS)
            if frames and frame_bytes == 0:
                break  # padding
            frames.append(reader.take(frame_bytes))
        if len(frames) % self.channels or len(frames) * self._frame_samples > self.packet_samples * self.channels:
            raise CodecError(
                f"a packet is damaged: {len(frames)} frames for {self.channels} channels; copy the file again"
            )
        return frames

    def _decode_frames(self, frames: list[bytes]) -> Decoded:
        """Return the decoded samples of all channels' frames; silence follows those of a shorter last packet."""
        count = len(frames) // self.channels
        samples = np.zeros((self.packet_samples, self.channels), dtype=np.int16)
        scale = 2 ** (16 - self._library.full_scale_bits)
        for channel, context in enumerate(self._contexts):
            own = frames[channel * count : (channel + 1) * count]
            if self._library.continuous and own:
                own = [b"".join(own)]
            parts = [part for frame in own for part in _decoded(context, frame)]
            kept = np.concatenate([np.empty(0, dtype=np.int16), *parts])[:: self._library.decimation]
            if len(kept) != count * self._frame_samples:
                raise CodecError("a packet is damaged: it decodes to fewer or more samples; copy the file again")
            samples[: len(kept), channel] = np.clip(kept.astype(np.int32) * scale, -32_768, 32_767)
        return samples


def _damaged(flaw: str) -> CodecError:
    return CodecError(f"a packet or configuration is damaged or cut short: {flaw}")


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
        context.sample_rate = LABEL_HZ
        context.layout = "mono"
        if sample_format:
            context.format = sample_format
        context.options = dict(options)
        context.thread_count = 1
        context.open()
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(f"FFmpeg's codec {name} cannot be opened here ({error}); install PyAV's own wheel") from error
    return context


def _decoded(context: Any, frame: bytes) -> list[NDArray[np.int16]]:
    """Return the samples in one codec frame. Raises CodecError if libav finds it malformed."""
    av = _av()
    if not frame:
        raise CodecError("a packet is damaged: it has an empty frame; copy the file again")
    try:
        decoded = context.decode(av.Packet(frame))
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(f"a frame is damaged and cannot be decoded ({error}); copy the file again") from error
    if any(part.format.name not in ("s16", "s16p") or part.layout.nb_channels != 1 for part in decoded):
        raise CodecError("a frame is damaged: another sample format or channel count; copy the file again")
    return [part.to_ndarray().ravel() for part in decoded]
