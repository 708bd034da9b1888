"""Streams to play on the controller under test, within its limits, and what they decode to."""

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from vibrocast import codec, models, textures
from vibrocast.codec.encoding import default_model, encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol.messages import ActuatorDescription, HelloResponse, Message, Start, Status, Tap
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.harness.conformance.probe import ANSWER_S, NotConforming, Probe, same_samples
from vibrocast.host import player
from vibrocast.host.controller import Controller
from vibrocast.host.devices import known_model
from vibrocast.output.actuator import Actuator

RATE_HZ = 2800
SECONDS = 0.4
# Moderate: no limit of the actuator acts. Of the displacement, or of the drive, from rest.
STRENGTH = 0.1
TONE_HZ = 150.0
_LOUD_HZ = 25.0
MODEL = "eva-16-4"
# Codecs without a model image. A test that needs no special codec plays the first that the controller has.
PLAIN_CODECS = tuple(known.name for known in codec.BUILT_IN.values() if known.keeps_waveform and not known.needs_model)
SignalMaker = Callable[[int, int, str, float, float], textures.Recording]
"""Makes a signal of a rate in hertz, of so many channels, in a unit, with a peak value, for so many seconds."""
# docs/reference/protocol.md, "Credit"
_MAX_PACKETS = 1024


def stream_for(
    hello: HelloResponse,
    codec_name: str | None = None,
    channels: int = 1,
    unit: str = "um",
    seconds: float = SECONDS,
    buffered: bool = True,
    make_signal: SignalMaker | None = None,
) -> Stream:
    """Return a coded signal that the controller can take, with refresh packets; skip the test where there is none.

    `codec_name`: None = one of PLAIN_CODECS. `buffered`: no longer than the controller's buffer. `make_signal`: makes
    the signal; None = `texture`.
    """
    limits = hello.limits
    names = PLAIN_CODECS if codec_name is None else (codec_name,)
    codec_name = next((name for name in names if (codec.codec_by_name(name).identifier, name) in hello.codecs), None)
    if codec_name is None:
        pytest.skip(f"the controller has no codec {' or '.join(names)}")
    if channels > limits.channels:
        pytest.skip(f"the controller has {limits.channels} channels")
    rate_hz = min(max(RATE_HZ, limits.min_rate_hz), limits.max_rate_hz)
    if buffered:
        seconds = min(seconds, 0.8 * limits.buffer_samples / rate_hz)
    peak = amplitude(hello.actuator, unit)
    stream = coded(
        make_signal or texture, codec_name, rate_hz, channels, unit, peak, seconds, limits.sendable_packet_bytes
    )
    if stream is None or stream.packet_samples * 2 > limits.buffer_samples:
        pytest.skip(f"no packet of {codec_name} fits the frames or the buffer of the controller")
    return stream


def lasting_stream(
    probe: Probe, requests: int, seconds: float = SECONDS, unit: str = "um", make_signal: SignalMaker | None = None
) -> Stream:
    """Return a stream, as `stream_for`, that still plays when `requests` behind its Start have been answered.

    It lasts for longer than `seconds` only where answers take long. Skips the test where the buffer does not hold it.
    """
    needed_s = (requests + 1) * probe.answer_s
    if needed_s > seconds:
        seconds = math.ceil(needed_s)
    stream = stream_for(probe.description, unit=unit, seconds=seconds, make_signal=make_signal)
    if stream.seconds < needed_s:
        pytest.skip(f"what the buffer holds has been played before {requests} requests are answered")
    return stream


def host(probe: Probe) -> Controller:
    """Return a session as a host has it, which repeats what is not answered."""
    return Controller(probe.link, probe.link.clock, probe.link.sleep)


def answered_s(probe: Probe) -> float:
    """Return how much to buffer, so that a request that waits for its answer, or goes out again, holds nothing up."""
    return max(player.BUFFER_S, 2 * probe.answer_s)


@cache
def coded(
    make_signal: SignalMaker,
    codec_name: str,
    rate_hz: int,
    channels: int,
    unit: str,
    peak: float,
    seconds: float,
    packet_bytes: int,
) -> Stream | None:
    """Return a signal coded by a middle setting, or the next coarser one whose packets are small enough, if any is."""
    chosen = codec.codec_by_name(codec_name)
    rate_point_set = chosen.rate_points
    for setting in reversed(rate_point_set[: len(rate_point_set) // 2 + 1]):
        encoding = encode_recording(
            make_signal(rate_hz, channels, unit, peak, seconds),
            rate_hz,
            codec_name,
            setting=setting,
            model=model(codec_name) if chosen.needs_model else None,
            live=True,
            highpass_hz=None,
        )
        if max(map(len, encoding.stream.packets)) <= packet_bytes:
            silent = not np.any(encoding.stream.decode_integers())  # packets of silence are short, too
            return None if silent else encoding.stream
    return None


def texture(rate_hz: int, channels: int, unit: str, peak: float, seconds: float) -> textures.Recording:
    """Return a tone with noise, another in each channel, of about this peak in the unit."""
    samples = round(seconds * rate_hz)
    phase = 2 * np.pi * TONE_HZ * np.arange(samples)[:, None] / rate_hz + np.arange(channels)
    noise = np.random.default_rng(5).standard_normal((samples, channels))
    return textures.Recording(peak * (0.6 * np.sin(phase) + 0.1 * noise), float(rate_hz), unit, "conformance")


def constant(rate_hz: int, channels: int, unit: str, peak: float, seconds: float) -> textures.Recording:
    """Return one value for so long."""
    samples = np.full((round(seconds * rate_hz), channels), peak)
    return textures.Recording(samples, float(rate_hz), unit, "conformance")


def loud(rate_hz: int, channels: int, unit: str, peak: float, seconds: float) -> textures.Recording:
    """Return a square wave of full scale: no signal has more power."""
    tone = np.sign(np.sin(2 * np.pi * _LOUD_HZ * np.arange(round(seconds * rate_hz)) / rate_hz))
    return textures.Recording(np.tile(tone[:, None], (1, channels)), float(rate_hz), unit, "conformance")


def amplitude(actuator: ActuatorDescription, unit: str) -> float:
    """Return a moderate peak value in the unit, for this actuator."""
    if unit == "full scale":
        return STRENGTH
    peak_um = STRENGTH * actuator.stroke_um / 2
    return peak_um if unit == "um" else peak_um * 1e-6 * (2 * np.pi * TONE_HZ) ** 2


@cache
def model(codec_name: str | None = None) -> models.Model:
    """Return a learned model of a codec, or of any; integers decode it, which give the same bits everywhere."""
    shipped = models.find(MODEL) if codec_name is None else default_model(codec.codec_by_name(codec_name))
    image = ModelImage.unpack(shipped.image)
    tables = codec.codec_by_identifier(image.codec_identifier).tables
    payload = tables.with_runtime(image.payload, "core") if tables and tables.with_runtime else image.payload
    return replace(shipped, image=replace(image, name="conformance", payload=payload).pack())


def need_no_signature(description: HelloResponse) -> None:
    """Skip the test where a controller takes signed model images only: nobody signs the suite's."""
    if description.public_key:
        pytest.skip("the controller takes signed model images only, and nobody signs the suite's")


def decoded(stream: Stream, first_packet: int = 0, missing: Collection[int] = ()) -> NDArray[np.int16]:
    """Return what a controller decodes, int16 (samples, channels), from a packet on, where some cannot be decoded."""
    header = stream.header
    decoder = codec.decoder(header.codec_identifier, header.configuration, header.channels, stream.tables)
    return np.concatenate(
        [
            decoder.conceal() if number in missing else decoder.decode(stream.packets[number])
            for number in range(first_packet, len(stream.packets))
        ]
    )


def play_on(probe: Probe, stream: Stream, configured: Status) -> int:
    """Feed and start a stream that is set up, and wait until it plays; return its number."""
    probe.feed(configured.stream, stream)
    probe.expect(Start(), Status)
    probe.wait_for(lambda status: status.position > 0, "to play", ANSWER_S)
    return configured.stream


def decoded_as(probe: Probe, expected: NDArray[np.int16], what: str) -> None:
    """Compare the decoded samples that the controller has kept with the expected ones, (samples, channels).

    Skips the test where it keeps nothing. Raises NotConforming, TransportError.
    """
    need_capture(probe.description)
    first, came = probe.captured(Tap.DECODED, expected.shape[1])
    if first != max(0, len(expected) - probe.description.limits.capture_samples):
        raise NotConforming(f"{what}: expected {len(expected)} samples captured, came {first + len(came)}")
    same_samples(came, expected[first:], what)


def known_actuator(description: ActuatorDescription) -> Actuator:
    """Return the model of an actuator whose DAC codes can be computed here; skip the test for any other."""
    known = known_model(description)
    if known is None:
        pytest.skip(f"the actuator {description.name!r} is none whose DAC codes can be computed here")
    return known


def held_samples(hello: HelloResponse, stream: Stream) -> int:
    """Return how many samples of a stream the buffer holds: whole packets, no more than credit may ever grant."""
    packet_samples = stream.packet_samples
    return min(_MAX_PACKETS, hello.limits.buffer_samples // packet_samples) * packet_samples


def dac_samples(probe: Probe, channels: int = 1) -> int:
    """Return how many DAC samples have been captured. Raises NotConforming, TransportError."""
    return probe.read_capture(Tap.DAC, 0, 0, channels).end


def need_since(hello: HelloResponse, kind: type[Message]) -> None:
    """Skip the test where the controller speaks a minor version from before a message."""
    if hello.minor < kind.SINCE:
        pytest.skip(f"the controller speaks version {hello.major}.{hello.minor}")


def need_capture(hello: HelloResponse) -> None:
    """Skip the test where the controller captures nothing."""
    if hello.limits.capture_samples == 0:
        pytest.skip("the controller captures nothing to read back")
