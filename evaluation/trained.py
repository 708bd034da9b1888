"""Facts of a trained model that the evaluation needs: which settings it takes, its runtimes, sizes and identity."""

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from vibrocast import codec, models
from vibrocast.codec import CodecError, Framing, Setting, SignalFormat
from vibrocast.codec.encoding import brings_built_in_tables
from vibrocast.codec.interface import LearnedTransform
from vibrocast.models import Model

_FORMAT = SignalFormat(2800, "full scale", (1.0,), (0.5,))


def known_models(folders: Iterable[Path]) -> list[Model]:
    """Return the models that ship, and those in your folders; none whose tables are built in anyway.

    Raises ModelError for a folder without a model, OSError for one that cannot be read, CodecError for a model of a
    codec that this version does not have.
    """
    every = [*models.shipped(), *map(models.load, folders)]
    return [model for model in every if not brings_built_in_tables(model)]


def codec_name(model: Model) -> str:
    """Return the name of the codec that a model is for."""
    return codec.codec_by_identifier(model.codec_identifier).name


def digest(model: Model) -> str:
    """Return a hash of all of a model that figures depend on."""
    return hashlib.sha256(model.image + model.analysis).hexdigest()


def rate_point_set(model: Model) -> list[Setting]:
    """Return the rate points of its codec's first set of rate points that differ with a model: one of a single rate has
    few of them.

    Of a model that no encoder takes the first, so that the reason stands among the failures.
    """
    known = codec.CODECS[codec_name(model)]
    every = known.rate_points
    different: dict[bytes, Setting] = {}
    for setting in every:
        with suppress(CodecError):
            encoder = known.make_encoder(known.complete(setting), _FORMAT, Framing(64, 0), model, None)
            different.setdefault(encoder.configuration, setting)
    return list(different.values()) or [every[0]]


def runtimes(model: Model) -> tuple[str, ...]:
    """Return which of codec.RUNTIMES can decode with a model; "" where there is no choice."""
    tables = codec.CODECS[codec_name(model)].tables
    if tables is None or tables.with_runtime is None:
        return ("",)
    found = []
    for runtime in codec.RUNTIMES:
        with suppress(CodecError):
            tables.with_runtime(model.tables, runtime)
            found.append(runtime)
    return tuple(found)


def width(model: Model) -> int | None:
    """Return the channels of the hidden layers of a model's learned transform; None where it has none."""
    transform = _learned_transform(model)
    return None if transform is None else transform.width


def flash_bytes(model: Model) -> int:
    """Return the bytes of a model's image without an ONNX graph, which no microcontroller runs."""
    transform = _learned_transform(model)
    return len(model.image) - (0 if transform is None else transform.graph_bytes)


def _learned_transform(model: Model) -> LearnedTransform | None:
    tables = codec.CODECS[codec_name(model)].tables
    return None if tables is None else tables.learned_transform(model.tables)
