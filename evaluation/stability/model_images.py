"""Model images that are wrong, damaged or missing: what is rejected, and what plays."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from vibrocast import codec, models
from vibrocast.codec import Signal
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.evaluation.stability.maps import Group, Map, Place, RatePoint, Rule, Scope, middle_rate_point
from vibrocast.evaluation.stability.signals import RATE_HZ, encoded, texture
from vibrocast.evaluation.stability.transport import flash_with
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial, Verdict
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


def measure_changed(rate_point: RatePoint, runtime: str, place_percent: float) -> Measured:
    """Decode with a changed payload that no CRC or hash reveals, and compare the samples. Raises CodecError."""
    stream = _stream(rate_point)
    payloads = rate_point.trained.tables, _changed(rate_point, place_percent)
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


def measure_cut(rate_point: RatePoint, percent: float) -> Measured:
    """Decode with a part of a payload, in an image whose CRC is right. Raises CodecError."""
    payload = rate_point.trained.tables
    cut = payload[: round(percent / 100 * len(payload))]
    header = _stream(rate_point).header
    codec.decoder(header.codec_identifier, header.configuration, header.channels, cut)
    return Measured(Outcome.HOLDS, {})


def measure_hash(rate_point: RatePoint) -> Measured:
    """Give a changed image, whose CRC is right, for a stream of the right one. Raises CodecError."""
    stream = _stream(rate_point)
    Stream(stream.header, stream.packets, _with_payload(rate_point, _changed(rate_point, 50.0))).decode()
    return Measured(Outcome.HOLDS, {})


def measure_crc(rate_point: RatePoint) -> Measured:
    """Read an image with one byte changed. Raises ModelError."""
    image = bytearray(rate_point.trained.image)
    image[len(image) // 2] ^= 0x55
    ModelImage.unpack(bytes(image))
    return Measured(Outcome.HOLDS, {})


def measure_missing(rate_point: RatePoint) -> Measured:
    """Decode without the image. Raises CodecError."""
    stream = _stream(rate_point)
    Stream(stream.header, stream.packets).decode()
    return Measured(Outcome.HOLDS, {})


def measure_on_controller(rate_point: RatePoint, image: bytes | None) -> Measured:
    """Play on a controller that has another image, or none. Raises ControllerError."""
    stream = _stream(rate_point)
    link = MemoryLink(Controller(flash=flash_with(image)))
    play(Host(link, link.clock, link.sleep), stream)
    return Measured(Outcome.HOLDS, {})


def _images(scope: Scope) -> Iterator[Trial]:
    for method in scope.learned:
        rate_point = middle_rate_point(method)
        another = next(model.image for model in models.shipped() if model.image != rate_point.trained.image)
        rejected: dict[str, Callable[[RatePoint], Measured]] = {
            "byte changed, CRC wrong": measure_crc,
            "byte changed, hash wrong": measure_hash,
            "no image for the decoder": measure_missing,
            "no image on the controller": partial(measure_on_controller, image=None),
            "other image on the controller": partial(measure_on_controller, image=another),
        }
        trial = partial(Trial, method.name, setting=rate_point.text)
        for case, measure in rejected.items():
            yield trial(case, partial(measure, rate_point), to_be_rejected=True)
        for percent in CUTS_PERCENT:
            yield trial(CUT, partial(measure_cut, rate_point, percent), value=percent, to_be_rejected=True)
        for runtime in runtimes(rate_point.trained):
            for percent in scope.some(PLACES_PERCENT, 4):
                changed = partial(measure_changed, rate_point, runtime, percent)
                yield trial(", ".join(filter(None, (CHANGED, runtime))), changed, value=percent)


def _place(cell: Verdict) -> Place:
    """Return the place of a cell: models and what decodes them downwards, what is wrong across."""
    if cell.value is None:
        return Place(cell.method, cell.case)
    if cell.case == CUT:
        return Place(cell.method, cell.value, "cut, % left")
    return Place(cell.method + cell.case.removeprefix(CHANGED), cell.value, "byte changed at, %")


def _message(cells: Sequence[Verdict]) -> str:
    wrong = [cell for cell in cells if cell.required is Outcome.REJECTED]
    accepted = sum(not cell.sound for cell in wrong)
    if accepted:
        return f"{accepted} of {len(wrong)} wrong images are accepted"
    return "Every wrong image is rejected; a changed byte passes where CRC and hash were made to fit"


IMAGES = Map(
    name="model_images",
    group=Group.LEARNED,
    title="Wrong model images",
    tried="A stream gets an image that it was not coded for. CRC, hash or controller must reject it. Then one byte "
    "changes, and CRC and hash are made to fit.",
    rule=Rule("decoded samples", "the same, or rejected as required", "crash (other samples: degraded)"),
    conditions=_images,
    message=_message,
    place=_place,
    caption="",
    value_name="place_percent",
    varied="{} % of the image",
)
