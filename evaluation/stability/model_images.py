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


def _with_payload(rate_point: RatePoint, payload: bytes) -> bytes:
    """Return a model's image, packed again with another payload: its CRC is right."""
    return replace(ModelImage.unpack(rate_point.trained.image), payload=payload).pack()


def _changed(rate_point: RatePoint, place_percent: float) -> bytes:
    """Return a model's payload with one byte changed at a place."""
    payload = bytearray(rate_point.trained.tables)
    payload[round(place_percent / 100 * (len(payload) - 1))] ^= 0x55
    return bytes(payload)


def measure_changed(trial: Trial) -> Measured:
    """Decode with a changed payload that no CRC or hash reveals, and compare the samples. Raises CodecError."""
    rate_point = trial.rate_point
    stream, runtime = _stream(rate_point), trial.case.removeprefix(CHANGED).removeprefix(", ")
    payloads = rate_point.trained.tables, _changed(rate_point, trial.value)
    expected, came = (_decoded(stream, payload, runtime) for payload in payloads)
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


def _use_another_hash(rate_point: RatePoint) -> None:
    """Give a changed image, whose CRC is right, for a stream of the right one. Raises CodecError."""
    stream = _stream(rate_point)
    Stream(stream.header, stream.packets, _with_payload(rate_point, _changed(rate_point, 50.0))).decode()


def _use_another_crc(rate_point: RatePoint) -> None:
    """Read an image with one byte changed. Raises ModelError."""
    image = bytearray(rate_point.trained.image)
    image[len(image) // 2] ^= 0x55
    ModelImage.unpack(bytes(image))


def _use_none(rate_point: RatePoint) -> None:
    """Decode without the image. Raises CodecError."""
    stream = _stream(rate_point)
    Stream(stream.header, stream.packets).decode()


def _play(rate_point: RatePoint, image: bytes | None) -> None:
    """Play on a controller that has another image, or none. Raises ControllerError."""
    stream = _stream(rate_point)
    link = MemoryLink(Controller(flash=flash_with(image)))
    play(Host(link, link.clock, link.sleep), stream)


def _play_another(rate_point: RatePoint) -> None:
    image = rate_point.trained.image
    _play(rate_point, next(model.image for model in models.shipped() if model.image != image))


WRONG: Mapping[str, Callable[[RatePoint], None]] = {
    "byte changed, CRC wrong": _use_another_crc,
    "byte changed, hash wrong": _use_another_hash,
    "no image for the decoder": _use_none,
    "no image on the controller": lambda rate_point: _play(rate_point, None),
    "other image on the controller": _play_another,
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
