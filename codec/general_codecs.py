"""Speech and audio codecs of FFmpeg's libraries, with their usual options; layout in docs/reference/bitstream.md."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from vibrocast.codec.interface import (
    Codec,
    Encoder,
    Framing,
    Model,
    Parameter,
    RateControl,
    Setting,
    Signal,
    SignalFormat,
    number,
    reject_rate_control,
    word,
)
from vibrocast.codec.libav import LABEL_HZ, LibavDecoder, LibavEncoder, Library, Plan
from vibrocast.codec.packetwise import PacketwiseEncoder
from vibrocast.device_protocol.encoding import pack_varint

_AMR_BITS_PER_SECOND = (4750, 5150, 5900, 6700, 7400, 7950, 10_200, 12_200)
# 3GPP TS 26.101, annex A: a byte of header, then the speech bits of the mode.
_AMR_FRAME_BYTES = (13, 14, 16, 18, 20, 21, 27, 32)
# At full amplitude G.726's coarse quantiser saturates, which costs up to 7 dB of SNR; so the signal is halved.
_G726_FULL_SCALE_BITS = 15
_OPUS_FRAMES_SAMPLES = (20, 40, 80, 160, 320, 480)
_OPUS_BITS_PER_SECOND = (6000, 8000, 10_000, 12_000, 16_000, 20_000, 24_000, 32_000, 48_000, 64_000)
_FEWEST_WAVPACK_BITS, _MAX_WAVPACK_BITS = 2, 16
_QUANTISER_OFFSETS_PER_BIT = 16
_WAVPACK_BITS_PER_SAMPLE = (3, 4, 5, 6, 7, 8, 10, 12, 14, 16)


def _plan_opus(setting: Setting, packet_samples: int) -> Plan:
    frame_samples = int(word(setting, "frame_samples"))
    options = {
        "b": str(number(setting, "bit_rate_bps")),
        "frame_duration": str(1000 * frame_samples / LABEL_HZ),
        # Never the speech coder: at the 48 kHz at which libav decodes, its delay is 0.7 of our samples longer.
        "application": "lowdelay",
        "vbr": "constrained",  # libopus's own default; FFmpeg's lets the rate drift far from the setting
    }
    return Plan(frame_samples, 20, options)


def _plan_amr(setting: Setting, packet_samples: int) -> Plan:
    mode = int(number(setting, "mode"))
    return Plan(160, 40, {"b": str(_AMR_BITS_PER_SECOND[mode])}, _AMR_FRAME_BYTES[mode])


def _plan_g723_1(setting: Setting, packet_samples: int) -> Plan:
    return Plan(240, 60, {"b": "6300"}, 24)


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


class RateControlledWavpackEncoder(PacketwiseEncoder):
    """Encoder of `wavpack` with rate control, which chooses how many bits of a packet's samples to keep.

    Each block of WavPack stands alone, so each trial has its own encoder.
    """

    def __init__(
        self, library: Library, plan: Plan, framing: Framing, channels: int, rate_control: RateControl
    ) -> None:
        """Make an encoder; `plan` has the bits at a quantiser offset of 0. Raises CodecError as `LibavEncoder`."""
        self.configuration = LibavEncoder(library, plan, framing, channels).configuration
        super().__init__(channels, framing, plan.frame_samples, 1)
        self._library, self._plan, self._framing, self._rate_control = library, plan, framing, rate_control
        self._quantiser_offsets = range(
            _QUANTISER_OFFSETS_PER_BIT * (plan.bits_per_sample - _MAX_WAVPACK_BITS),
            _QUANTISER_OFFSETS_PER_BIT * (plan.bits_per_sample - _FEWEST_WAVPACK_BITS) + 1,
        )
        self._sequence = 0

    def _code_packets(self, samples: Signal) -> list[bytes]:
        return [self._packet_of(part) for part in np.split(samples, len(samples) // self.packet_samples)]

    def _packet_of(self, samples: Signal) -> bytes:
        def code(quantiser_offset: int) -> bytes:
            bits = self._plan.bits_per_sample - round(quantiser_offset / _QUANTISER_OFFSETS_PER_BIT)
            plan = replace(self._plan, bits_per_sample=bits)
            encoder = LibavEncoder(self._library, plan, self._framing, self._channels)
            (packet,) = encoder.encode(samples) + encoder.finish()
            return pack_varint(2 * self._sequence + 1) + packet[1:]

        packet = self._chosen(samples, code)
        self._sequence += 1
        return packet


def _codec(
    name: str,
    identifier: int,
    summary: str,
    library: Library,
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
        Library("libopus", "libopus", _plan_opus, decimation=6, file="libopus"),
        {
            "bit_rate_bps": Parameter(
                "mean bit rate, in bit/s at 8000 samples/s", 16_000, low=500, high=128_000, whole=True
            ),
            "frame_samples": Parameter("samples in a frame", "160", choices=tuple(map(str, _OPUS_FRAMES_SAMPLES))),
        },
        tuple({"bit_rate_bps": rate} for rate in _OPUS_BITS_PER_SECOND),
        block_parameter="frame_samples",
    ),
    _codec(
        "amr-nb",
        6,
        "AMR narrow-band (3GPP TS 26.071), ACELP speech codec, by libopencore",
        Library("libopencore_amrnb", "libopencore_amrnb", _plan_amr, file="libopencore-amrnb"),
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
        Library("g723_1", "g723_1", _plan_g723_1),
        {},
        ({},),
    ),
    _codec(
        "g726",
        8,
        "ITU-T G.726, adaptive differential PCM",
        Library(
            "g726",
            "g726",
            _plan_g726,
            continuous=True,
            full_scale_bits=_G726_FULL_SCALE_BITS,
            settling_samples=1280,
            decoder_options=lambda frame_bytes: {"bits_per_coded_sample": str(frame_bytes)},
        ),
        {"bits_per_sample": Parameter("bits per coded sample", 4, low=2, high=5, whole=True)},
        tuple({"bits_per_sample": bits} for bits in range(2, 6)),
    ),
    _codec(
        "wavpack",
        9,
        "WavPack, lossless linear prediction, after rounding the samples to fewer bits",
        Library("wavpack", "wavpack", _plan_wavpack, sample_format="s16p", settling_samples=0, controls_rate=True),
        {
            "bits_per_sample": Parameter(
                "bits kept of each sample; 16 = lossless", 8, _FEWEST_WAVPACK_BITS, _MAX_WAVPACK_BITS, True
            )
        },
        tuple({"bits_per_sample": bits} for bits in _WAVPACK_BITS_PER_SAMPLE),
    ),
    _codec(
        "flac",
        10,
        "FLAC (RFC 9639), lossless linear prediction of the 16-bit samples",
        Library("flac", "flac", _plan_flac, settling_samples=0),
        {},
        ({},),
    ),
)
