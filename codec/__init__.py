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
    gain_for,
    live_framing,
)
from codec.interface import CodecError, CodedSignal, Decoded, Decoder, Encoder, Framing, Signal
from codec.rate_control import RATE_TOLERANCE, SNR_TOLERANCE_DB, channel_snrs_db, encode_to_rate, encode_to_snr, snr_db

__all__ = [
    "CODECS",
    "RATE_TOLERANCE",
    "SNR_TOLERANCE_DB",
    "Codec",
    "CodecError",
    "CodedSignal",
    "Decoded",
    "Decoder",
    "Encoder",
    "Framing",
    "Signal",
    "channel_snrs_db",
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
