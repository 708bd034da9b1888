"""Runs transforms of learned codecs in ONNX Runtime: checks graphs from elsewhere, uses one thread, reuses graphs."""

import os
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import CodecError
from vibrocast.codec.onnx_check import ADVICE, End, check_graph

SIGNAL = "signal"
"""Name of a graph's samples, float32 (batch, 1, 16 n)."""
LATENTS = "latents"
"""Name of a graph's latents, float32 (batch, latents, n)."""
MAX_MEMORY_BYTES = 2**30
"""Memory limit of all graphs together."""
HOP = 16
"""Samples of each column of latents."""
MAX_PACKET_COLUMNS = 4095
"""Columns of the longest packet."""
CONTEXT_COLUMNS = 4
"""Columns before a packet that ONNX Runtime synthesises again: the first sample depends on three of them."""
_MAX_COLUMNS = CONTEXT_COLUMNS + MAX_PACKET_COLUMNS
_MAX_SAMPLES = {SIGNAL: HOP * _MAX_COLUMNS, LATENTS: _MAX_COLUMNS}


class Transform:
    """A graph with one float32 input and one float32 output of three axes, ready to run on one thread."""

    def __init__(self, graph: bytes, source: str, result: str) -> None:
        """Load a graph from the input named `source` to the output named `result`.

        Raises CodecError when the bytes are no such graph.
        """
        ends = (End(name, _MAX_SAMPLES[name]) for name in (source, result))
        self.source_channels, self.result_channels = check_graph(graph, *ends)
        onnxruntime = _runtime()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # no log: errors are raised
        options.add_session_config_entry("session.use_env_allocators", "1")
        # ONNX Runtime looks for weights outside the graph in this folder, which holds none: no graph reads files of the
        # user.
        options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
        try:
            self._session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        except Exception as error:
            # ONNX Runtime's exceptions have no common class of their own.
            raise CodecError(f"this is no ONNX graph that can be run; {ADVICE}") from error
        self._source, self._result = source, result

    def __call__(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run on (batch, channels, time). Raises CodecError when the graph fails."""
        try:
            (result,) = self._session.run([self._result], {self._source: values})
        except Exception as error:
            raise CodecError(f"the ONNX graph fails on an array of shape {values.shape}; {ADVICE}") from error
        return np.asarray(result)


@cache
def _runtime() -> Any:
    """Load ONNX Runtime and limit its memory: on first use, because it is slow and few streams need it."""
    import onnxruntime

    memory = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    limit = onnxruntime.OrtArenaCfg({"max_mem": MAX_MEMORY_BYTES})
    onnxruntime.create_and_register_allocator(memory, limit)
    return onnxruntime


@lru_cache(maxsize=32)
def transform(graph: bytes, source: str, result: str) -> Transform:
    """Return a loaded graph, the same one for the same bytes. Raises as `Transform`."""
    return Transform(graph, source, result)
