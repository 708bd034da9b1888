"""Decoders in Python for the controller in C: ONNX Runtime, and codecs of other packages."""

from typing import Any

import numpy as np

from vibrocast import codec
from vibrocast.codec import CodecError, Decoder
from vibrocast.device_protocol.messages import ErrorCode
from vibrocast.simulated_device.callbacks import Callbacks


class PythonDecoders:
    """Decodes codecs for which the controller has no decoder in C: `pointer` is its vc_decoder_callbacks.

    `runtime`: the one of codec.RUNTIMES that decodes models which leave the choice; None = as the image says.
    """

    def __init__(self, ffi: Any, library: Any, runtime: str | None, callbacks: Callbacks) -> None:
        self._ffi, self._library, self._runtime = ffi, library, runtime
        self._decoder: Decoder | None = None
        self._decoded: codec.Decoded | None = None
        names = {known.identifier: known.name.encode() for known in codec.CODECS.values()}
        texts = [ffi.new("uint8_t[]", name) for name in names.values()]
        named = [(number, (text, len(names[number]))) for number, text in zip(names, texts, strict=True)]
        functions = {
            "check_tables": callbacks.make(
                "int(void *, uint8_t, const uint8_t *, size_t, vc_rejection *)", self._check_tables, -1
            ),
            "check": callbacks.make("int(void *, vc_coding *, vc_rejection *)", self._check, -1),
            "init": callbacks.make("void(void *, const vc_coding *)", self._init),
            "feed": callbacks.make("int(void *, const uint8_t *, size_t)", self._feed, 0),
            "poll": callbacks.make("uint32_t(void *, int16_t *)", self._poll, 0),
        }
        codecs = ffi.new("vc_codec_description[]", named)
        self._kept = (texts, functions, codecs)
        self.pointer = ffi.new("vc_decoder_callbacks *", {"codecs": codecs, "codec_count": len(named), **functions})

    def _check_tables(self, context: Any, identifier: int, tables: Any, length: int, rejection: Any) -> int:
        try:
            known = codec.codec_by_identifier(identifier).tables
            if known is None or known.with_runtime is None:
                return int(self._library.VC_NOT_BY_CALLBACKS)
            codec.check_tables(identifier, bytes(self._ffi.buffer(tables, length)))
        except CodecError as error:
            return self._reject(rejection, ErrorCode.IMAGE_REJECTED, error)
        return 0

    def _check(self, context: Any, coding: Any, rejection: Any) -> int:
        try:
            tables, known = self._tables(coding), codec.codec_by_identifier(coding.codec, self._configuration(coding))
            if known.name in codec.PEERS:
                raise CodecError(
                    f"no controller decodes {known.name}, a codec that is only compared with; choose another"
                )
            runtime = "core"
            if tables is not None and known.tables is not None:
                if self._runtime is not None and known.tables.with_runtime is not None:
                    tables = known.tables.with_runtime(tables, self._runtime)
                runtime = known.tables.runtime_of(tables)
            if self._library.vc_codec_is_in_c(coding.codec) and runtime == "core":
                return int(self._library.VC_NOT_BY_CALLBACKS)
            decoder = self._make(coding)
        except CodecError as error:
            return self._reject(rejection, ErrorCode.UNKNOWN_CODEC, error)
        coding.packet_samples, coding.delay_samples = decoder.packet_samples, decoder.delay_samples
        return 0

    def _init(self, context: Any, coding: Any) -> None:
        self._decoder = self._make(coding)

    def _feed(self, context: Any, packet: Any, length: int) -> int:
        assert self._decoder is not None, "a stream has begun"
        try:
            self._decoded = self._decoder.decode(bytes(self._ffi.buffer(packet, length))) if packet else None
        except CodecError:
            return 0
        return 1

    def _poll(self, context: Any, samples: Any) -> int:
        """Write the whole packet at once: these decoders cannot stop within one."""
        assert self._decoder is not None, "a stream has begun"
        decoded = self._decoder.conceal() if self._decoded is None else self._decoded
        np.frombuffer(self._ffi.buffer(samples, decoded.nbytes), np.int16)[:] = decoded.ravel()
        return len(decoded)

    def _make(self, coding: Any) -> Decoder:
        configuration, tables = self._configuration(coding), self._tables(coding)
        return codec.decoder(coding.codec, configuration, coding.channels, tables, self._runtime)

    def _configuration(self, coding: Any) -> bytes:
        return bytes(self._ffi.buffer(coding.configuration, coding.configuration_length))

    def _tables(self, coding: Any) -> bytes | None:
        return bytes(self._ffi.buffer(coding.tables, coding.tables_length)) if coding.tables else None

    def _reject(self, rejection: Any, code: ErrorCode, error: CodecError) -> int:
        return int(self._library.vc_reject(rejection, code, str(error).encode()))
