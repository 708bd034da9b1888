"""Speech and audio codecs through FFmpeg's libraries (PyAV), as others would use them; layout in docs/bitstream.md."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import extras
from vibrocast.codec.interface import (
    Codec,
    CodecError,
    Decoded,
    Encoder,
    Framing,
    Model,
    Parameter,
    RateControl,
    Setting,
    Signal,
    SignalFormat,
    check_channels,
    checked_parts,
    number,
    reject_rate_control,
    word,
)
from vibrocast.codec.packetwise import PacketwiseEncoder
from vibrocast.codec.trial import PacketTrial, rate_controlled_packet
from vibrocast.device_protocol.encoding import pack_varint, unpack_varint

LABEL_HZ = 8000
"""The rate that samples of every stream are passed off as: speech codecs have no other, the rest do not mind."""

_MAX_PACKET_SAMPLES = 65_535
_MAX_SEQUENCE_BITS = 33
_CHUNK_SAMPLES = 1 << 18
_FADE_SAMPLES = 256
_RISE_SAMPLES = 32
_AMR_BITS_PER_SECOND = (4750, 5150, 5900, 6700, 7400, 7950, 10_200, 12_200)
# 3GPP TS 26.101, annex A: a byte of header, then the speech bits of the mode.
_AMR_FRAME_BYTES = (13, 14, 16, 18, 20, 21, 27, 32)
# At full amplitude its coarse quantiser saturates, which costs up to 7 dB of SNR: it gets half of it.
_G726_FULL_SCALE_BITS = 15
_OPUS_FRAMES_SAMPLES = (20, 40, 80, 160, 320, 480)
_OPUS_BITS_PER_SECOND = (6000, 8000, 10_000, 12_000, 16_000, 20_000, 24_000, 32_000, 48_000, 64_000)
_FEWEST_WAVPACK_BITS, _MAX_WAVPACK_BITS = 2, 16
_QUANTISER_OFFSETS_PER_BIT = 16
_WAVPACK_BITS_PER_SAMPLE = (3, 4, 5, 6, 7, 8, 10, 12, 14, 16)


@dataclass(frozen=True)
class _Plan:
    """How a codec codes with one setting.

    `frame_samples`: of one codec frame. `delay_samples`: by which decoded signal lags. `options`: of libav's encoder.
    `frame_bytes`: of every codec frame, 0 where they differ. `bits_per_sample`: kept of each sample before coding.
    """

    frame_samples: int
    delay_samples: int
    options: Mapping[str, str]
    frame_bytes: int = 0
    bits_per_sample: int = 16


@dataclass(frozen=True)
class _Library:
    """What libav's encoder and decoder of a codec are called, and how they differ from the others.

    `plan(setting, packet_samples)`. `decimation`: of decoded samples, one of so many is kept. `continuous`: frames
    have no bounds, and those of a packet are decoded at once. `full_scale_bits`: 16, fewer where the codec wants
    headroom. `settling_samples`: that a decoder which begins anew in the middle of a stream takes to find the signal.
    `decoder_options(frame_bytes)`. `controls_rate`: WavPack does. `file`: as `Codec.library`.
    """

    encoder: str
    decoder: str
    plan: Callable[[Setting, int], _Plan]
    sample_format: str = "s16"
    decimation: int = 1
    continuous: bool = False
    full_scale_bits: int = 16
    settling_samples: int = 640  # 80 ms at 8 kHz, the pre-roll of RFC 7845, 4.6; enough for the speech codecs too
    decoder_options: Callable[[int], Mapping[str, str]] = lambda frame_bytes: {}
    controls_rate: bool = False
    file: str = ""


def _plan_opus(setting: Setting, packet_samples: int) -> _Plan:
    frame_samples = int(word(setting, "frame_samples"))
    options = {
        "b": str(number(setting, "bit_rate_bps")),
        "frame_duration": str(1000 * frame_samples / LABEL_HZ),
        # Never the speech coder: in the 48 kHz at which libav decodes, it lags by 0.7 of our samples more.
        "application": "lowdelay",
        "vbr": "constrained",  # libopus's own default; FFmpeg's lets the rate run away from what was asked
    }
    return _Plan(frame_samples, 20, options)


def _plan_amr(setting: Setting, packet_samples: int) -> _Plan:
    mode = int(number(setting, "mode"))
    return _Plan(160, 40, {"b": str(_AMR_BITS_PER_SECOND[mode])}, _AMR_FRAME_BYTES[mode])


def _plan_g723_1(setting: Setting, packet_samples: int) -> _Plan:
    return _Plan(240, 60, {"b": "6300"}, 24)


def _plan_g726(setting: Setting, packet_samples: int) -> _Plan:
    bits = int(number(setting, "bits_per_sample"))
    # Eight samples fill whole bytes.
    return _Plan(8, 0, {"code_size": str(bits)}, bits, _G726_FULL_SCALE_BITS)


def _plan_wavpack(setting: Setting, packet_samples: int) -> _Plan:
    frame_samples = max(128, packet_samples)
    options = {"frame_size": str(frame_samples), "compression_level": "4"}
    return _Plan(frame_samples, 0, options, bits_per_sample=int(number(setting, "bits_per_sample")))


def _plan_flac(setting: Setting, packet_samples: int) -> _Plan:
    frame_samples = max(16, packet_samples)
    return _Plan(frame_samples, 0, {"frame_size": str(frame_samples), "compression_level": "8"})


class LibavEncoder:
    """Encoder of all these codecs; see codec.interface.Encoder. Samples beyond full scale are clipped to it."""

    def __init__(self, library: _Library, plan: _Plan, framing: Framing, channels: int) -> None:
        """Make an encoder of so many channels, each coded alone.

        Raises CodecError on a channel count or packet length that a stream cannot have, or where libav is missing.
        """
        check_channels(channels)
        self._library = library
        self._plan = plan
        self._packet_frames = -(-framing.packet_samples // plan.frame_samples)
        self.packet_samples = self._packet_frames * plan.frame_samples
        self.delay_samples = plan.delay_samples
        if not 1 <= self.packet_samples <= _MAX_PACKET_SAMPLES:
            raise CodecError(f"packets of {framing.packet_samples} samples; 1 to {_MAX_PACKET_SAMPLES} are allowed")
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
        """Pad with zeros and return the packets that remain; the last holds no more frames than are needed."""
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
        """Give libav the frames that it wants; at the end a shorter one, and whatever it holds back is taken."""
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
        """Return the packets of the frames that are there; at the end the last may be short of some."""
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


class RateControlledWavpackEncoder(PacketwiseEncoder):
    """Encoder of `wavpack` that keeps as many bits of each packet's samples as are chosen for it.

    Each block of WavPack stands alone, so a trial is coded by an encoder of its own.
    """

    def __init__(
        self, library: _Library, plan: _Plan, framing: Framing, channels: int, rate_control: RateControl
    ) -> None:
        """Make an encoder; `plan` has the bits of a quantiser offset of 0. Raises CodecError as `LibavEncoder`."""
        self.configuration = LibavEncoder(library, plan, framing, channels).configuration
        super().__init__(channels, framing, plan.frame_samples, 1)
        self._library, self._plan, self._framing, self._rate_control = library, plan, framing, rate_control
        self._quantiser_offsets = range(
            _QUANTISER_OFFSETS_PER_BIT * (plan.bits_per_sample - _MAX_WAVPACK_BITS),
            _QUANTISER_OFFSETS_PER_BIT * (plan.bits_per_sample - _FEWEST_WAVPACK_BITS) + 1,
        )
        self._sequence = self._quantiser_offset = 0

    def _code_packets(self, samples: Signal) -> list[bytes]:
        return [self._packet_of(part) for part in np.split(samples, len(samples) // self.packet_samples)]

    def _packet_of(self, samples: Signal) -> bytes:
        def code(quantiser_offset: int) -> bytes:
            bits = self._plan.bits_per_sample - round(quantiser_offset / _QUANTISER_OFFSETS_PER_BIT)
            plan = replace(self._plan, bits_per_sample=bits)
            encoder = LibavEncoder(self._library, plan, self._framing, self._channels)
            (packet,) = encoder.encode(samples) + encoder.finish()
            return pack_varint(2 * self._sequence + 1) + packet[1:]

        trial = PacketTrial(samples, self._quantiser_offsets, self._quantiser_offset, code)
        self._quantiser_offset, packet = rate_controlled_packet(trial, self._rate_control, code)
        self._sequence += 1
        return packet


class LibavDecoder:
    """Decoder of all these codecs; see codec.interface.Decoder."""

    def __init__(self, library: _Library, configuration: bytes, channels: int) -> None:
        """Make a decoder from the codec's bytes in the stream header.

        Raises CodecError when they are not valid, or where libav is missing.
        """
        check_channels(channels)
        self._library = library
        self.channels = channels
        reader = _Reader(configuration)
        self.delay_samples, self._frame_samples, packet_frames, self._frame_bytes = (reader.varint() for _ in range(4))
        self.packet_samples = packet_frames * self._frame_samples
        if not reader.at_end or not 1 <= self.packet_samples <= _MAX_PACKET_SAMPLES:
            raise CodecError("the codec configuration is damaged or of another version")
        self._contexts: Sequence[Any] = self._fresh_contexts()
        self._next_sequence: int | None = 0
        self._samples_since_gap = library.settling_samples + _RISE_SAMPLES
        self._last: Decoded = np.zeros((self.packet_samples, channels), dtype=np.int16)

    def decode(self, packet: bytes) -> Decoded:
        """Decode the next packet to int16 (packet_samples, channels). Raises CodecError on a malformed packet."""
        reader = _Reader(packet)
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
        """Stand in for one missing packet: the last sound, backwards and faded out, then silence."""
        samples = np.zeros_like(self._last)
        fade = np.linspace(1, 0, min(_FADE_SAMPLES, self.packet_samples))[:, None]
        samples[: len(fade)] = np.rint(self._last[::-1][: len(fade)] * fade)
        self._last = np.zeros_like(self._last)
        self._next_sequence = None
        return samples

    def _fresh_contexts(self) -> list[Any]:
        options = self._library.decoder_options(self._frame_bytes)
        return [_open(self._library.decoder, "r", options) for _ in range(self.channels)]

    def _frames(self, reader: "_Reader") -> list[bytes]:
        """Return the codec frames of a packet, all of one channel before those of the next."""
        frames: list[bytes] = []
        while not reader.at_end:
            frame_bytes = self._frame_bytes or reader.varint()
            if frames and frame_bytes == 0:
                break  # padding
            frames.append(reader.take(frame_bytes))
        if len(frames) % self.channels or len(frames) * self._frame_samples > self.packet_samples * self.channels:
            raise CodecError(f"a packet of {len(frames)} frames for {self.channels} channels; it was damaged")
        return frames

    def _decode_frames(self, frames: list[bytes]) -> Decoded:
        """Return what frames of all channels decode to; behind those of a last, shorter packet comes silence."""
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
                raise CodecError("a packet does not decode to as many samples as it covers; it was damaged")
            samples[: len(kept), channel] = np.clip(kept.astype(np.int32) * scale, -32_768, 32_767)
        return samples


class _Reader:
    """Takes fields off the front of `data` and checks every length."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0

    @property
    def at_end(self) -> bool:
        return self._position == len(self._data)

    def take(self, count: int) -> bytes:
        taken = self._data[self._position : self._position + count]
        if len(taken) < count:
            raise CodecError("a packet or configuration is cut short; it was damaged")
        self._position += count
        return taken

    def varint(self, bits: int = 16) -> int:
        """Take a LEB128 number of at most so many bits."""
        try:
            value, self._position = unpack_varint(self._data, self._position, bits)
        except ValueError as error:
            raise CodecError(
                "a number in a packet or configuration is cut short or too large; it was damaged"
            ) from error
        return value


def _av() -> Any:
    """Return the package `av`, imported at first need: it takes as long as all the rest. Raises CodecError."""
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
    """Return an open libav context of one channel. Raises CodecError where this build does not have the codec."""
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
    """Return the samples in one codec frame. Raises CodecError where libav finds it malformed."""
    av = _av()
    if not frame:
        raise CodecError("a packet with an empty frame; it was damaged")
    try:
        decoded = context.decode(av.Packet(frame))
    except (av.FFmpegError, ValueError) as error:
        raise CodecError(f"a frame that cannot be decoded ({error}); it was damaged") from error
    if any(part.format.name not in ("s16", "s16p") or part.layout.nb_channels != 1 for part in decoded):
        raise CodecError("a frame of another sample format or channel count; it was damaged")
    return [part.to_ndarray().ravel() for part in decoded]


def _codec(
    name: str,
    identifier: int,
    summary: str,
    library: _Library,
    parameters: Mapping[str, Parameter],
    rate_point_set: tuple[Setting, ...],
    block_parameter: str | None = None,
) -> Codec:
    def make_encoder(
        setting: Setting,
        signal_format: SignalFormat,
        framing: Framing,
        model: Model | None,
        rate_control: RateControl | None = None,
    ) -> Encoder:
        plan = library.plan(setting, framing.packet_samples)
        if rate_control is not None and library.controls_rate:
            return RateControlledWavpackEncoder(library, plan, framing, signal_format.channels, rate_control)
        reject_rate_control(name, rate_control)
        return LibavEncoder(library, plan, framing, signal_format.channels)

    def make_decoder(configuration: bytes, channels: int, tables: bytes | None) -> LibavDecoder:
        return LibavDecoder(library, configuration, channels)

    return Codec(
        name,
        identifier,
        summary,
        parameters,
        {name: rate_point_set},
        make_encoder,
        make_decoder,
        controls_rate=library.controls_rate,
        block_parameter=block_parameter,
        library=library.file,
    )


CODECS = (
    _codec(
        "opus",
        5,
        "Opus (RFC 6716), its low-delay MDCT coder, by libopus",
        _Library("libopus", "libopus", _plan_opus, decimation=6, file="libopus"),
        {
            "bit_rate_bps": Parameter("bit/s at 8000 samples/s, on average", 16_000, low=500, high=128_000, whole=True),
            "frame_samples": Parameter("samples in a frame", "160", choices=tuple(map(str, _OPUS_FRAMES_SAMPLES))),
        },
        tuple({"bit_rate_bps": rate} for rate in _OPUS_BITS_PER_SECOND),
        block_parameter="frame_samples",
    ),
    _codec(
        "amr-nb",
        6,
        "AMR narrow-band (3GPP TS 26.071), ACELP speech codec, by libopencore",
        _Library("libopencore_amrnb", "libopencore_amrnb", _plan_amr, file="libopencore-amrnb"),
        {
            "mode": Parameter(
                "0 to 7: 4.75, 5.15, 5.9, 6.7, 7.4, 7.95, 10.2, 12.2 kbit/s at 8000 samples/s", 7, 0, 7, True
            )
        },
        tuple({"mode": mode} for mode in range(8)),
    ),
    _codec(
        "g723-1",
        7,
        "ITU-T G.723.1, multi-pulse speech codec of 6.3 kbit/s at 8000 samples/s",
        _Library("g723_1", "g723_1", _plan_g723_1),
        {},
        ({},),
    ),
    _codec(
        "g726",
        8,
        "ITU-T G.726, adaptive differential PCM",
        _Library(
            "g726",
            "g726",
            _plan_g726,
            continuous=True,
            full_scale_bits=_G726_FULL_SCALE_BITS,
            settling_samples=1280,
            decoder_options=lambda frame_bytes: {"bits_per_coded_sample": str(frame_bytes)},
        ),
        {"bits_per_sample": Parameter("coded bits of each sample", 4, low=2, high=5, whole=True)},
        tuple({"bits_per_sample": bits} for bits in range(2, 6)),
    ),
    _codec(
        "wavpack",
        9,
        "WavPack, lossless linear prediction, of samples rounded to fewer bits",
        _Library("wavpack", "wavpack", _plan_wavpack, sample_format="s16p", settling_samples=0, controls_rate=True),
        {
            "bits_per_sample": Parameter(
                "bits kept of each sample, 16 = lossless", 8, _FEWEST_WAVPACK_BITS, _MAX_WAVPACK_BITS, True
            )
        },
        tuple({"bits_per_sample": bits} for bits in _WAVPACK_BITS_PER_SAMPLE),
    ),
    _codec(
        "flac",
        10,
        "FLAC (RFC 9639), lossless linear prediction of the 16-bit samples",
        _Library("flac", "flac", _plan_flac, settling_samples=0),
        {},
        ({},),
    ),
)
