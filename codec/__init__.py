"""Signal to integers to bytes and back: transforms, quantisers, entropy coding, rate control."""

from codec.coding import (
    CODECS,
    Codec,
    codec_by_identifier,
    codec_by_name,
    decode,
    decode_integers,
    decoder,
    encode,
    encode_to_rate,
    encode_to_snr,
    gain_for,
    live_framing,
    snr_db,
)
from codec.interface import CodecError, CodedSignal, Decoded, Decoder, Encoder, Framing, Signal

__all__ = [
    "CODECS",
    "Codec",
    "CodecError",
    "CodedSignal",
    "Decoded",
    "Decoder",
    "Encoder",
    "Framing",
    "Signal",
    "codec_by_identifier",
    "codec_by_name",
    "decode",
    "decode_integers",
    "decoder",
    "encode",
    "encode_to_rate",
    "encode_to_snr",
    "gain_for",
    "live_framing",
    "snr_db",
]
