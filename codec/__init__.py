"""Encodes and decodes signals: codecs, coded streams, rate control, searches for a rate or an SNR."""

# ruff: noqa: I001 - one list of the exported names for each module
from vibrocast.codec.interface import (
    RUNTIMES as RUNTIMES,
    Choice as Choice,
    Codec as Codec,
    CodecError as CodecError,
    Decoded as Decoded,
    Decoder as Decoder,
    Encoder as Encoder,
    Framing as Framing,
    Model as Model,
    Parameter as Parameter,
    RateControl as RateControl,
    Setting as Setting,
    Signal as Signal,
    SignalFormat as SignalFormat,
    TargetUnreachable as TargetUnreachable,
    Trial as Trial,
)
from vibrocast.codec.metrics import channel_snrs_db as channel_snrs_db, snr_db as snr_db
from vibrocast.codec.plugins import BlockCodec as BlockCodec, as_codec as as_codec
from vibrocast.codec.rate_control import (
    CappedRate as CappedRate,
    ConstantRate as ConstantRate,
    RatePolicy as RatePolicy,
    SnrMeter as SnrMeter,
    encode_rate_controlled as encode_rate_controlled,
    rate_controlled_encoder as rate_controlled_encoder,
    rate_controlled_framing as rate_controlled_framing,
)
from vibrocast.codec.registry import (
    BUILT_IN as BUILT_IN,
    CODECS as CODECS,
    DEFAULT_CODEC as DEFAULT_CODEC,
    PEERS as PEERS,
    check_tables as check_tables,
    codec_by_identifier as codec_by_identifier,
    codec_by_name as codec_by_name,
    decoder as decoder,
)
from vibrocast.codec.source import (
    Progress as Progress,
    Source as Source,
    encode as encode,
    live_format as live_format,
    live_framing as live_framing,
    recording_format as recording_format,
    timed_framing as timed_framing,
)
from vibrocast.codec.stream import Stream as Stream, gain_for as gain_for, nearest_gain as nearest_gain
from vibrocast.codec.target_search import (
    RATE_TOLERANCE as RATE_TOLERANCE,
    SNR_TOLERANCE_DB as SNR_TOLERANCE_DB,
    encode_to_rate as encode_to_rate,
    encode_to_snr as encode_to_snr,
)
from vibrocast.codec.threshold import DEFAULT_TOUCH as DEFAULT_TOUCH, shape_setting as shape_setting
