"""Runs transforms of learned codecs in ONNX Runtime: checks graphs from elsewhere, uses one thread, reuses graphs."""

import os
import re
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import extras
from vibrocast.codec.interface import CodecError

SIGNAL = "signal"
"""Name of a graph's samples, float32 (batch, 1, 16 n)."""
LATENTS = "latents"
"""Name of a graph's latents, float32 (batch, latents, n)."""
MAX_MEMORY_BYTES = 2**30
"""Memory limit of all graphs together."""
# Operators that may run for ever, as a serialised graph names them: after the last byte of the name's length.
_LOOPS = re.compile(rb"[\x00\x04](Loop|Scan)")
_ADVICE = "give a graph that `vibrocast export` wrote"


class Transform:
    """A graph with one float32 input and one float32 output of three axes, ready to run on one thread."""

    def __init__(self, graph: bytes, source: str, result: str) -> None:
        """Load a graph from the input named `source` to the output named `result`.

        Raises CodecError when the bytes are no such graph.
        """
        if _LOOPS.search(graph):
            raise CodecError(f"this ONNX graph has a loop, which need not end; {_ADVICE}")
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
            raise CodecError(f"this is no ONNX graph that can be run; {_ADVICE}") from error
        ends = [*self._session.get_inputs(), *self._session.get_outputs()]
        if [(end.name, end.type, len(end.shape)) for end in ends] != [
            (name, "tensor(float)", 3) for name in (source, result)
        ]:
            found = ", ".join(f"{end.name} {end.type} {end.shape}" for end in ends)
            raise CodecError(f"this ONNX graph has {found} instead of {source} and {result} with three axes; {_ADVICE}")
        self._source, self._result = source, result
        self.source_channels, self.result_channels = ends[0].shape[1], ends[1].shape[1]

    def __call__(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run on (batch, channels, time). Raises CodecError when the graph fails."""
        try:
            (result,) = self._session.run([self._result], {self._source: values})
        except Exception as error:
            raise CodecError(f"the ONNX graph fails on an array of shape {values.shape}; {_ADVICE}") from error
        return np.asarray(result)


@cache
def _runtime() -> Any:
    """Load ONNX Runtime and limit its memory: on first use, because it is slow and few streams need it.

    Raises CodecError if it is not installed.
    """
    if advice := extras.advice("learned"):
        raise CodecError(advice)
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
