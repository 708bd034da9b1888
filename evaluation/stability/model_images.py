"""Model images that are wrong, damaged or missing: what is rejected, and what plays."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from vibrocast import codec, models
from vibrocast.codec import Signal
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.evaluation.cells import RatePoint
from vibrocast.evaluation.stability.maps import Map, Row, Scope, at_level
from vibrocast.evaluation.stability.signals import RATE_HZ, encoded, texture
from vibrocast.evaluation.stability.transport import flash_with
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial
from vibrocast.evaluation.trained import runtimes
from vibrocast.host.controller import Controller as Host
from vibrocast.host.player import play
from vibrocast.simulated_device.controller import Controller
from vibrocast.simulated_device.memory_link import MemoryLink

PLACES_PERCENT = tuple(5.0 * place for place in range(21))
CHANGED, CUT = "byte changed, CRC and hash fit", "cut, CRC and hash fit"
CUTS_PERCENT = (0.0, 1.0, 10.0, 50.0, 90.0, 99.0)


@lru_cache(maxsize=1)
def _stream(rate_point: RatePoint) -> Stream:
    return encoded(texture(), RATE_HZ, rate_point, live=True)


def _changed(data: bytes, place_percent: float) -> bytes:
    """Return an image or its payload with one byte changed at a place."""
    place = round(place_percent / 100 * (len(data) - 1))
    return data[:place] + bytes((data[place] ^ 0x55,)) + data[place + 1 :]


def measure_changed(trial: Trial) -> Measured:
    """Decode with a changed payload that no CRC or hash reveals, and compare the samples. Raises CodecError."""
    rate_point = trial.rate_point
    stream, runtime = _stream(rate_point), trial.case.removeprefix(CHANGED).removeprefix(", ")
    tables = rate_point.trained.tables
    expected, came = (_decoded(stream, payload, runtime) for payload in (tables, _changed(tables, trial.value)))
    snr_db = codec.snr_db(expected, came)
    assert snr_db is not None, "a texture is not silent"
    if math.isinf(snr_db):
        return Measured(Outcome.HOLDS, {"snr_db": None})
    return Measured(Outcome.DEGRADED, {"snr_db": snr_db}, f"another signal, SNR {snr_db:z.1f} dB")


def _decoded(stream: Stream, payload: bytes, runtime: str) -> Signal:
    """Return the samples of a stream's packets, decoded with a payload, whatever image the stream names."""
    header = stream.header
    decoder = codec.decoder(header.codec_identifier, header.configuration, header.channels, payload, runtime or None)
    return np.concatenate([decoder.decode(packet) for packet in stream.packets]).astype(np.float64)


def measure_cut(trial: Trial) -> Measured:
    """Decode with a part of a payload, in an image whose CRC is right. Raises CodecError."""
    payload, header = trial.rate_point.trained.tables, _stream(trial.rate_point).header
    cut = payload[: round(trial.value / 100 * len(payload))]
    codec.decoder(header.codec_identifier, header.configuration, header.channels, cut)
    return Measured(Outcome.HOLDS, {})


def _with_another_hash(rate_point: RatePoint) -> bytes:
    """Return a model's image, packed again with a changed payload: its CRC is right."""
    return replace(ModelImage.unpack(rate_point.trained.image), payload=_changed(rate_point.trained.tables, 50)).pack()


def _play(rate_point: RatePoint, image: bytes | None) -> None:
    """Play on a controller that has another image, or none. Raises ControllerError."""
    link = MemoryLink(Controller(flash=flash_with(image)))
    play(Host(link, link.clock, link.sleep), _stream(rate_point))


def _another(image: bytes) -> bytes:
    return next(model.image for model in models.shipped() if model.image != image)


WRONG: Mapping[str, Callable[[RatePoint], object]] = {
    "byte changed, CRC wrong": lambda rate_point: ModelImage.unpack(_changed(rate_point.trained.image, 50)),
    "byte changed, hash wrong": lambda rate_point: replace(
        _stream(rate_point), image=_with_another_hash(rate_point)
    ).decode(),
    "no image for the decoder": lambda rate_point: replace(_stream(rate_point), image=None).decode(),
    "no image on the controller": lambda rate_point: _play(rate_point, None),
    "other image on the controller": lambda rate_point: _play(rate_point, _another(rate_point.trained.image)),
}
"""Uses of a wrong image that are rejected."""


def measure_wrong(trial: Trial) -> Measured:
    """Use a wrong image in one of the ways of WRONG. Raises CodecError, ModelError or ControllerError."""
    WRONG[trial.case](trial.rate_point)
    return Measured(Outcome.HOLDS, {})


def _learned(scope: Scope) -> Iterator[Trial]:
    return at_level("middle", scope.learned)


def _by_runtime(scope: Scope) -> Iterator[Trial]:
    for begun in _learned(scope):
        for runtime in runtimes(begun.rate_point.trained):
            yield replace(begun, case=", ".join(filter(None, (CHANGED, runtime))))


IMAGES = Map(
    "model_images",
    globals(),
    [
        Row(measure_wrong, _learned, tuple(WRONG), rejected=WRONG),
        Row(measure_cut, _learned, [CUT], CUTS_PERCENT, rejected=[CUT]),
        Row(measure_changed, _by_runtime, values=PLACES_PERCENT, value_step=4),
    ],
)
