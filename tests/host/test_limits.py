"""Streams against a controller's limits: packets split where the codec allows it, else advice that can be followed."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from tests.command import succeeds
from tests.conftest import linked
from tests.host.scripted_controller import ScriptedController
from vibrocast import codec, models, textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream, read_stream
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.device_protocol.messages import CodecDescription, Configure, Error, ErrorCode
from vibrocast.host import playback, stream_session
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.devices import session_with
from vibrocast.host.stream_session import check_limits, configure_steps, fitted
from vibrocast.simulated_device.controller import Settings

BUFFER_SAMPLES = 4096
RECORDING = textures.GENERATORS["rough"](seconds=1.5)


def controller(buffer_samples: int = BUFFER_SAMPLES, capture_samples: int = 1 << 19) -> Controller:
    """Return a session with a simulated controller whose buffer, and so whose packets, are short."""
    return linked(Settings(buffer_samples=buffer_samples, capture_samples=capture_samples))[1]


def file_of(codec_name: str, rate_hz: int = 8000) -> Stream:
    """Return a stream with packets of 4096 samples or, where hosts can split it, of all samples."""
    return encode_recording(RECORDING, rate_hz, codec_name).stream


def test_packets_that_are_too_long_are_split_and_play_as_computed() -> None:
    stream = file_of("mdct")
    assert stream.packet_samples > BUFFER_SAMPLES
    outcome = playback.play(session_with(controller(), "sim"), "rough", stream, loops=2)
    assert outcome.stream is not None and outcome.stream.packet_samples <= BUFFER_SAMPLES // 2
    assert outcome.report.stream_bytes == outcome.stream.size_bytes
    assert outcome.report.underruns == outcome.report.lost_packets == 0
    assert outcome.report.decoded_equals_offline is outcome.report.dac_equals_offline is True


def test_packets_of_more_bytes_than_a_frame_takes_are_split() -> None:
    stream = encode_recording(RECORDING, snr_db=40).stream
    session = controller()
    short = replace(session.description.limits, max_payload_bytes=600, max_packet_bytes=580)
    session.description = replace(session.description, limits=short)
    assert max(map(len, stream.packets)) > 600
    assert max(map(len, fitted(session, stream).packets)) <= short.sendable_packet_bytes


@pytest.mark.parametrize(
    ("capture_samples", "note"),
    [(256, "keeps 256 samples of each capture"), (0, "the controller keeps no captures"), (1 << 19, None)],
)
def test_the_report_says_why_nothing_is_compared(capture_samples: int, note: str | None) -> None:
    report = playback.play(
        session_with(controller(capture_samples=capture_samples), "memory"), "rough", file_of("mdct")
    ).report
    assert report.underruns == 0 and not report.differs
    assert (report.decoded_equals_offline, report.dac_equals_offline) == ((None, None) if note else (True, True))
    assert (report.comparison_note or "") == "" if note is None else note in (report.comparison_note or "")


@pytest.mark.parametrize("codec_name", ["slp", "dct", "eva", "parametric"])
def test_the_advice_for_packets_that_cannot_be_split_gives_a_stream_that_fits(codec_name: str, tmp_path: Path) -> None:
    session = controller(buffer_samples=2048)
    with pytest.raises(StreamError, match="packets of 4096 samples") as raised:
        fitted(session, file_of(codec_name))
    (command,) = re.findall(r"`vibrocast (.*)`", str(raised.value))
    recording, out = tmp_path / "rough.wav", tmp_path / "out.vct"
    textures.save(recording, RECORDING)
    succeeds(*shlex.split(command.replace("RECORDING", str(recording)).replace("OUT.vct", str(out))))
    assert fitted(session, stream := read_stream(out)) is stream


@pytest.mark.parametrize(
    ("channels", "rate_hz", "advice"),
    [
        (9, 2800, "take some with `columns`"),
        (1, 99, "encode the recording with `stream_rate_hz` 100"),
        (1, 48_001, "encode the recording with `stream_rate_hz` 48000"),
    ],
)
def test_channels_and_rates_beyond_the_limits_are_rejected_with_advice(
    channels: int, rate_hz: int, advice: str
) -> None:
    session = controller()
    narrow = replace(session.description.limits, max_rate_hz=48_000)
    session.description = replace(session.description, limits=narrow)
    with pytest.raises(StreamError, match=advice):
        check_limits(session, channels, rate_hz)


CYCLES = {"mdct": 300, "dct": 200, "slp": 250, "eva": 0}


def cycles_of(identifier: int, configuration: bytes, channels: int, tables: bytes | None) -> int:
    """Return invented cycles: of EVA, a fiftieth of the model's bytes."""
    return channels * (len(tables or b"") // 50 or CYCLES[codec.codec_by_identifier(identifier).name])


def rejecting(limit_kilocycles_per_s: int) -> Controller:
    """Return a session with a controller that rejects each Configure because of its cost."""
    scripted = ScriptedController()
    codecs = tuple(CodecDescription(codec.BUILT_IN[name].identifier, name) for name in CYCLES)
    slow = replace(scripted.description.limits, decoding_kilocycles_per_s=limit_kilocycles_per_s)
    scripted.description = replace(scripted.description, codecs=codecs, limits=slow)
    rejection = Error(ErrorCode.BEYOND_LIMITS, "too much")
    scripted.answer = lambda message: rejection if isinstance(message, Configure) else None
    return Controller(scripted, lambda: scripted.now_s)


@pytest.mark.parametrize(
    ("codec_name", "limit_kilocycles_per_s", "advice"),
    [
        ("eva-128-4", 1500, "with --model eva-16-5 or --codec mdct or --stream-rate-hz 117"),
        ("eva-128-4", 800, "with --codec slp"),
        ("mdct", 800, "with --codec slp or --stream-rate-hz 2666"),
        ("mdct", 10, "use fewer channels"),
    ],
)
def test_a_stream_that_takes_too_long_to_decode_is_rejected_with_what_can_be_decoded(
    codec_name: str, limit_kilocycles_per_s: int, advice: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_session, "decoding_cycles", cycles_of)
    model = None if codec_name == "mdct" else models.find(codec_name)
    stream = encode_recording(RECORDING, model=model, live=True).stream
    session = rejecting(limit_kilocycles_per_s)
    with pytest.raises(ControllerError, match=f"million cycles a second, .*{advice}"):
        session.run(configure_steps(session, stream.header, 0))


def test_other_rejections_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_session, "decoding_cycles", cycles_of)
    stream = encode_recording(RECORDING, live=True).stream
    for session in (rejecting(0), rejecting(10_000)):
        with pytest.raises(ControllerError, match="too much; `vibrocast status` lists its limits"):
            session.run(configure_steps(session, stream.header, 0))
