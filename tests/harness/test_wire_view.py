"""The view of a wire: what a page shows of a playback, and that no frames, however hostile, break or swell it."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.device_protocol.test_coded_stream import headers
from tests.device_protocol.test_messages import MESSAGES
from vibrocast import textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.device_protocol.frames import DELIMITER, write_frame
from vibrocast.device_protocol.messages import CaptureData, Configure, HelloResponse, Message, PacketMessage, pack
from vibrocast.device_protocol.trace import TracedFrame, read_trace, tracer
from vibrocast.harness.wire_view import WireView
from vibrocast.host import devices, playback
from vibrocast.host.devices import session_with


def frame(message: Message, from_host: bool = True, time_ns: int = 0) -> TracedFrame:
    return TracedFrame(time_ns, from_host, "x", write_frame(pack(message)).removesuffix(DELIMITER))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Sequence[TracedFrame]:
    """The frames of a texture that was played and read back."""
    path = tmp_path_factory.mktemp("traces") / "played.pcapng"
    encoding = encode_recording(textures.GENERATORS["rough"](seconds=1.0), live=True)
    with tracer.writing(path), devices.connect("sim") as controller:
        playback.play(session_with(controller, "sim"), "rough", encoding.stream, encoding)
    return list(read_trace(path))


def view_of(frames: Iterable[TracedFrame]) -> WireView:
    view = WireView()
    view.note(frames)
    return view


def test_a_playback_is_shown_as_it_was(played: Sequence[TracedFrame]) -> None:
    shown = view_of(played).document()
    assert shown["state"] == "finished" and shown["codec"] == "mdct" and shown["hints"] == []
    assert not any(shown["counters"].values())
    levels = {name: signal["rms_um"] for name, signal in shown["signals"].items()}
    assert set(levels) == {"sent", "read back"} and all(0 < level < 100 for level in levels.values())
    at_hz = {name: np.array(shown["spectra"][name]) for name in levels}
    both = [np.interp(200.0, *spectrum.T) for spectrum in at_hz.values()]
    assert both[0] == pytest.approx(both[1], abs=3.0)
    assert max(ms for _, ms in shown["buffer_ms"]) > 100


def test_a_lost_packet_a_wrong_sample_and_a_missing_capture_are_seen(played: Sequence[TracedFrame]) -> None:
    sent = [each for each in played if (found := each.message()) and isinstance(found[1], PacketMessage)]
    without = view_of(each for each in played if each is not sent[2]).document()
    assert without["counters"]["samples decoded wrongly"] > 0
    assert any("decodes other samples than were sent" in hint for hint in without["hints"])
    unread = [each for each in played if not (found := each.message()) or not isinstance(found[1], CaptureData)]
    assert "Nothing is read back." in view_of(unread).document()["hints"][0]
    damaged = [TracedFrame(0, False, "x", b"\x01\x02\x03"), *played]
    assert "Frames are damaged on the wire." in view_of(damaged).document()["hints"][0]


def test_a_page_that_opens_late_says_so(played: Sequence[TracedFrame]) -> None:
    configured = next(
        number for number, each in enumerate(played) if (found := each.message()) and isinstance(found[1], Configure)
    )
    late = view_of(played[configured + 1 :]).document()
    assert late["note"] == "no stream has been set up while this page was open"
    assert late["signals"] == {} and late["state"] == "finished"


messages = st.one_of(*MESSAGES.values())
setups = st.builds(lambda header, first: Configure(1, header.pack(), 0, first_packet=first), headers, st.integers(0, 9))


@settings(deadline=None, max_examples=200)
@given(st.lists(st.tuples(st.one_of(messages, setups), st.booleans()), max_size=30))
def test_no_frames_break_the_view(drawn: list[tuple[Message, bool]]) -> None:
    view = view_of(frame(message, from_host, time_ns) for time_ns, (message, from_host) in enumerate(drawn))
    json.dumps(view.document(), allow_nan=False)


@pytest.mark.parametrize(
    "changed",
    [{"dac_rate_hz": 0}, {"dac_rate_hz": 2**32 - 1}, {"volts": 0.0}, {"volts": math.inf}, {"stroke_um": math.nan}],
    ids=str,
)
def test_an_impossible_controller_breaks_nothing(changed: dict[str, float], played: Sequence[TracedFrame]) -> None:
    frames = list(played)
    for number, each in enumerate(frames):
        if (found := each.message()) and isinstance(found[1], HelloResponse):
            hello = replace(found[1], actuator=replace(found[1].actuator, **changed))  # type: ignore[arg-type]
            frames[number] = frame(hello, False)
    json.dumps(view_of(frames).document(), allow_nan=False)


def test_memory_is_bounded(played: Sequence[TracedFrame]) -> None:
    view = view_of(each for _ in range(20) for each in played)
    assert len(json.dumps(view.document())) < 200_000
