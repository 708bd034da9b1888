"""The costs of a codec: processor time, delay, memory and decoder size."""

import json
import multiprocessing
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

import vibrocast.evaluation.peers  # noqa: F401 - fills codec.PEERS, in each process that measures
from vibrocast import codec
from vibrocast.codec import Framing, Setting, SignalFormat
from vibrocast.evaluation import trained
from vibrocast.models import Model
from vibrocast.workers import end_with_parent

T = TypeVar("T")

MEMORY_SECONDS, MEMORY_RATE_HZ = 100, 2800
DECODER_SIZES = Path(__file__).parent / "data" / "decoder_sizes.json"
"""Counted by `python -m studies.decoder_sizes`."""


@dataclass(frozen=True)
class DecoderSize:
    """Bytes of a codec's decoder, None where they are unknown. `note`: the counted parts, or why none was counted."""

    bytes: int | None
    note: str


@dataclass(frozen=True)
class CodecCost:
    """The costs of a codec, or of `coder` with a family of models, that hold for every signal; None where unknown.

    `decoder_bytes`: of the decoder's code; `note` names the parts. `model_bytes`: of the images of a family of
    models without their ONNX graphs, which no microcontroller runs; None for a codec without models. `width`: channels
    of a model's hidden layers.
    """

    codec: str
    decoder_bytes: int | None
    peak_memory_bytes: int | None
    note: str
    model_bytes: int | None = None
    coder: str = ""
    width: int | None = None

    @property
    def flash_bytes(self) -> int | None:
        """The bytes that a controller holds to decode: code and models."""
        return None if self.decoder_bytes is None else self.decoder_bytes + (self.model_bytes or 0)


def delay_ms(
    codec_name: str,
    setting: Setting,
    rate_hz: int,
    channels: int = 1,
    unit: str = "full scale",
    model: Model | None = None,
) -> float:
    """Return the algorithmic delay: from a sample's arrival to its play-out, were computing and transport instant.

    It is the codec's shortest packet, whose first sample waits for its last, and the samples by which decoded signal
    lags (overlap and look-ahead). Longer packets are a choice of framing, and do not count. Raises CodecError where the
    codec does not have the setting, rate or channels.
    """
    signal_format = SignalFormat(rate_hz, unit, gains=(1.0,) * channels, rms=(1.0,) * channels)
    plug_in = codec.codec_by_name(codec_name)
    encoder = plug_in.make_encoder(plug_in.complete(setting), signal_format, Framing(1, 1), model, None)
    return 1e3 * (encoder.packet_samples + encoder.delay_samples) / rate_hz


def peak_memory_bytes(codec_name: str, model: Model | None = None) -> int | None:
    """Return the resident memory that coding adds at its peak to a fresh process; None on Windows.

    The process encodes and decodes 100 s of Gaussian noise, RMS 0.1, one channel at 2800 Hz, at the codec's default
    setting. The memory before, with libraries and tables, is measured after coding a tenth of a second.
    """
    if sys.platform == "win32":
        return None
    # Not "spawn": on Linux, a child of a large process begins with its parent's peak; one of the fork server does not.
    with ProcessPoolExecutor(1, multiprocessing.get_context("forkserver"), end_with_parent) as fresh:
        return fresh.submit(_memory_added, codec_name, model).result()


def _memory_added(codec_name: str, model: Model | None) -> int:
    noise = np.random.default_rng(0).normal(0, 0.1, (MEMORY_SECONDS * MEMORY_RATE_HZ, 1))
    before = 0
    for part in (noise[: MEMORY_RATE_HZ // 10], noise):
        before = _peak_resident_bytes()
        codec.encode(part, MEMORY_RATE_HZ, {}, codec=codec_name, model=model).decode()
    return _peak_resident_bytes() - before


def _peak_resident_bytes() -> int:
    import resource  # Windows has none

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def measure_costs(
    wanted: Mapping[str, tuple[str, Sequence[Model]]],
    progress: Callable[[float, str], None] = lambda part, details: None,
) -> list[CodecCost]:
    """Return the costs of each, a codec and perhaps a family of models by a name of its own.

    Where one fails to code, its note says so, and its memory is None. `progress` is called with the part done, from 0
    to 1, and the name of the measured codec.
    """
    costs = []
    for place, (name, (codec_name, models)) in enumerate(wanted.items(), 1):
        size = decoder_size(codec_name)
        cost = CodecCost(name, size.bytes, None, size.note, coder=codec_name)
        if models:
            note = f"{size.note}; model: {len(models)} images" if len(models) > 1 else size.note
            model_bytes = sum(map(trained.flash_bytes, models))
            cost = replace(cost, model_bytes=model_bytes, note=note, width=trained.width(models[0]))
        try:
            costs.append(replace(cost, peak_memory_bytes=peak_memory_bytes(codec_name, models[0] if models else None)))
        except Exception as error:  # whatever one codec raises, the others' costs are wanted
            costs.append(replace(cost, note=f"{cost.note}; memory not measured: {error}"))
        progress(place / len(wanted), name)
    return costs


def decoder_size(codec_name: str) -> DecoderSize:
    """Return the size of a codec's decoder (see docs/reference/metrics.md)."""
    return _decoder_sizes().get(codec_name, DecoderSize(None, "decoder not counted"))


@cache
def _decoder_sizes() -> dict[str, DecoderSize]:
    return {name: DecoderSize(**size) for name, size in json.loads(DECODER_SIZES.read_text(encoding="utf-8")).items()}
