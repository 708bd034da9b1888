"""The conformance suite: what docs/protocol.md asks of a controller, seen from a host."""

from dataclasses import replace

import numpy as np
import pytest

import codec
import textures
from codec import eva
from device_protocol.coded_stream import IMAGE_HASH_BYTES, StreamHeader
from device_protocol.messages import (
    PROTOCOL_MAJOR,
    Configure,
    ErrorCode,
    FlashBegin,
    FlashData,
    FlashStatus,
    FlashVerify,
    Gain,
    Hello,
    HelloResponse,
    Message,
    Pause,
    Resume,
    SlotState,
    Start,
    State,
    Status,
)
from device_protocol.model_image import ModelImage, sha256
from export.package import Contents
from host import coding
from host.controller import Controller as Host
from host.controller import ControllerError
from host.flasher import flash
from host.player import Progress, play
from tests.export import tiny

RATE_HZ = 2800


def coded_sine(seconds: float) -> tuple[StreamHeader, tuple[bytes, ...], codec.Decoded, int]:
    """Return header, packets, what they decode to, and the samples in a packet."""
    samples = round(seconds * RATE_HZ)
    signal = 10.0 * np.sin(2 * np.pi * 200 * np.arange(samples) / RATE_HZ)[:, None]
    coded = codec.encode(signal, RATE_HZ, {"step": 0.2}, live=True)
    header = StreamHeader(1, RATE_HZ, samples, "um", coded.gains, coded.configuration)
    packet_samples = codec.decoder(1, coded.configuration, 1).packet_samples
    return header, coded.packets, codec.decode_integers(coded), packet_samples


def refusal(session: Host, message: Message) -> int | None:
    with pytest.raises(ControllerError) as refused:
        session.request(message, Status)
    assert str(refused.value)
    return refused.value.code


def empty_slot(session: Host) -> int:
    return next(image.slot for image in session.description.images if image.state == SlotState.EMPTY)


def test_hello_tells_what_the_controller_is(session: Host) -> None:
    described = session.description
    assert described.major == PROTOCOL_MAJOR
    assert described.limits.maximum_payload_bytes >= 256
    assert described.limits.watchdog_ms >= 50
    assert described.limits.channels >= 1
    assert described.actuator.dac_rate_hz > 0
    assert codec.CODECS["mdct"].identifier in [identifier for identifier, _ in described.codecs]
    assert len(described.images) >= 2


def test_other_major_version_is_refused(session: Host) -> None:
    with pytest.raises(ControllerError) as refused:
        session.request(Hello(major=PROTOCOL_MAJOR + 1), HelloResponse)
    assert refused.value.code == ErrorCode.UNSUPPORTED_VERSION
    assert session.request_status()


def test_recording_is_played_as_decoded_offline(session: Host) -> None:
    header, packets, decoded, packet_samples = coded_sine(0.6)
    result = play(session, header, packets, packet_samples, capture=True)
    assert result.state == State.FINISHED
    assert (result.underruns, result.lost_packets) == (0, 0)
    assert result.decoded is not None
    assert result.dac_codes is not None
    np.testing.assert_array_equal(result.decoded, decoded)
    assert result.dac_codes.any()
    assert not result.dac_codes[-1].any()


def test_loops_play_back_to_back(session: Host) -> None:
    header, packets, decoded, packet_samples = coded_sine(0.3)
    result = play(session, header, packets, packet_samples, loops=2, capture=True)
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, np.tile(decoded, (2, 1)))
    assert result.dac_codes is not None
    # The recording is whole periods of a sine, which goes on across the seam: no window of 10 ms is weaker than others.
    window = session.description.actuator.dac_rate_hz // 100
    sound = result.dac_codes[np.flatnonzero(result.dac_codes[:, 0])[0] : np.flatnonzero(result.dac_codes[:, 0])[-1]]
    windows = sound[2 * window : -3 * window].astype(float)
    levels = [np.std(windows[start : start + window]) for start in range(0, len(windows) - window, window)]
    assert min(levels) > 0.8 * max(levels)


def test_stop_works_in_every_state_and_at_once(session: Host) -> None:
    assert session.stop().state == State.STOPPED
    header, packets, _, packet_samples = coded_sine(2.0)

    def stop_early(progress: Progress) -> None:
        if progress.position_s > 0.1:
            session.stop()

    result = play(session, header, packets, packet_samples, capture=True, progress=stop_early)
    assert result.state == State.STOPPED
    assert result.decoded is not None
    assert len(result.decoded) < RATE_HZ
    assert result.dac_codes is not None
    assert not result.dac_codes[-1].any()
    assert session.stop().state == State.STOPPED


def test_stop_after_the_end_stays_stopped(session: Host) -> None:
    header, packets, _, packet_samples = coded_sine(0.1)
    assert play(session, header, packets, packet_samples).state == State.FINISHED
    assert session.stop().state == State.STOPPED
    assert session.request_status().state == State.STOPPED


def test_pause_resume_and_gain(session: Host) -> None:
    header, packets, decoded, packet_samples = coded_sine(0.5)
    done: list[State] = []

    def pause_once(progress: Progress) -> None:
        if not done and progress.status.state == State.PLAYING and progress.position_s > 0.1:
            done.append(session.request(Pause(), Status).state)
            done.append(session.request(Resume(), Status).state)
            done.append(session.request(Gain(0.5), Status).state)

    result = play(session, header, packets, packet_samples, capture=True, progress=pause_once)
    assert done[0] == State.PAUSED
    assert result.state == State.FINISHED
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, decoded)


def test_requests_in_the_wrong_state_are_refused(session: Host) -> None:
    for message in (Start(), Pause(), Resume(), Gain(1.0)):
        assert refusal(session, message) == ErrorCode.WRONG_STATE


def test_streams_that_cannot_be_played_are_refused_with_their_reason(session: Host) -> None:
    header, packets, _, _ = coded_sine(0.1)
    values = (header.rate_hz, header.samples, header.unit, header.gains)
    unknown_codec = StreamHeader(15, *values, header.configuration)
    unknown_image = StreamHeader(1, *values, header.configuration, b"\xab" * IMAGE_HASH_BYTES)
    assert refusal(session, Configure(1, b"no header", 0, packets=1)) == ErrorCode.BAD_VALUE
    assert refusal(session, Configure(1, unknown_codec.pack(), 0, packets=1)) == ErrorCode.UNKNOWN_CODEC
    with pytest.raises(ControllerError, match="abababab"):
        session.request(Configure(1, unknown_image.pack(), 0, packets=len(packets)), Status)


def test_model_image_is_flashed_tried_and_kept(session: Host) -> None:
    hardware = session.description.hardware
    image = ModelImage(1, "conformance", "1", hardware, codec.mdct.built_in_tables()).pack()
    kept = flash(session, image)
    assert (kept.name, kept.version, kept.state) == ("conformance", "1", SlotState.CONFIRMED)


def test_image_that_its_codec_cannot_use_is_refused_and_the_old_one_plays(session: Host) -> None:
    hardware, tables = session.description.hardware, codec.mdct.built_in_tables()
    old, bad = (ModelImage(1, "old", "1", hardware, payload).pack() for payload in (tables, tables[:-1]))
    flash(session, old)
    with pytest.raises(ControllerError) as refused:
        flash(session, bad)
    assert refused.value.code == ErrorCode.IMAGE_REFUSED
    header, packets, decoded, packet_samples = coded_sine(0.3)
    named = replace(header, image_hash=sha256(old)[:IMAGE_HASH_BYTES])
    result = play(session, named, packets, packet_samples, capture=True)
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, decoded)


@pytest.mark.parametrize("contents", ["core", "onnx"])
def test_learned_codec_plays_with_the_model_that_was_flashed(session: Host, contents: Contents) -> None:
    if (eva.IDENTIFIER, eva.NAME) not in session.description.codecs:
        pytest.skip("this controller has no learned codec")
    model = tiny.model(contents)
    recording = textures.GENERATORS["rough"](0, 0.3)
    stream = coding.encode(recording, setting={"quality": 1}, model=model, live=True).stream
    flash(session, model.image)
    packet_samples = stream.decoder().packet_samples
    result = play(session, stream.header, stream.packets, packet_samples, capture=True)
    assert result.decoded is not None
    np.testing.assert_array_equal(result.decoded, stream.decode_integers())


def test_image_for_other_hardware_is_refused(session: Host) -> None:
    with pytest.raises(ControllerError) as refused:
        session.request(FlashBegin(empty_slot(session), 100, bytes(32), "other hardware"), FlashStatus)
    assert refused.value.code == ErrorCode.WRONG_HARDWARE


def test_damaged_image_is_refused_and_the_slot_is_empty(session: Host) -> None:
    slot, image = empty_slot(session), bytes(range(200))
    assert session.request(FlashBegin(slot, len(image), sha256(image), ""), FlashStatus).next_offset == 0
    assert session.request(FlashData(slot, 50, image[50:]), FlashStatus).next_offset == 0
    assert session.request(FlashData(slot, 0, image), FlashStatus).next_offset == len(image)
    with pytest.raises(ControllerError) as refused:
        session.request(FlashVerify(slot), FlashStatus)
    assert refused.value.code == ErrorCode.IMAGE_REFUSED
    session.say_hello()
    assert slot == empty_slot(session)
