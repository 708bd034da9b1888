"""Playing, with the samples read back and compared: over loops, with differences, and for signals that are too long."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal

from tests.conftest import linked, session, texture
from vibrocast import models
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.stream import Stream
from vibrocast.codec.threshold import over_threshold_db, read_threshold
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.device_protocol.messages import CaptureData, Gain, Message, Pause, Resume, SlotState, Status, Tap
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.host import devices, playback, uploader
from vibrocast.host.controller import Controller, ControllerError, Steps
from vibrocast.host.devices import actuator_model, session_with
from vibrocast.host.playback import Playback
from vibrocast.host.player import Progress
from vibrocast.host.stream_session import Capture
from vibrocast.output.actuator import LRA, PIEZO_STACK, VOICE_COIL, Actuator
from vibrocast.output.actuator_constants import constants, image
from vibrocast.simulated_device.controller import FLASH_BYTES, Settings
from vibrocast.simulated_device.controller import Controller as SimulatedController
from vibrocast.simulated_device.flash import FlashMemory
from vibrocast.simulated_device.memory_link import MemoryLink

LOOPS = 3
SAMPLES = 1000
SINE = np.sin(np.arange(SAMPLES) / 3.0)


def play(actuator: Actuator = PIEZO_STACK) -> Playback:
    encoding = encode_recording(texture(SINE), live=True)
    _, controller = linked(Settings(actuator=actuator))
    return playback.play(session_with(controller, "memory"), "sine", encoding.stream, encoding, LOOPS)


def test_every_pass_is_compared() -> None:
    outcome = play()
    assert outcome.report.decoded_equals_offline is True
    assert outcome.report.dac_equals_offline is True
    assert "read back" in outcome.caption


def test_a_model_is_uploaded_only_for_a_stream_that_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    def too_long(*_: object) -> Stream:
        raise StreamError("its packets are too long")

    monkeypatch.setattr(playback, "fitted", too_long)
    encoding = encode_recording(texture(SINE), live=True, model=models.find("mdct-textures"))
    _, controller = linked()
    with pytest.raises(StreamError, match="too long"):
        playback.play(session_with(controller, "sim"), "sine", encoding.stream, encoding)
    controller.open_session()
    assert all(image.state == SlotState.EMPTY for image in controller.description.images)


@pytest.mark.parametrize("asked", [(Gain(0.5),), (Pause(), Resume()), ()])
def test_what_a_program_changes_while_it_plays_is_no_difference(asked: tuple[Message, ...]) -> None:
    encoding = encode_recording(texture(SINE), live=True)
    _, controller = linked()
    left = list(asked)

    def change(now: Progress) -> None:
        if left and now.position_s > 0.02:
            controller.request(left.pop(0), Status)

    report = playback.play(session_with(controller, "sim"), "sine", encoding.stream, loops=10, progress=change).report
    assert not left and not report.differs
    assert (report.dac_equals_offline, report.comparison_note is None) == ((None, False) if asked else (True, True))


@pytest.mark.parametrize("tap", Tap)
def test_difference_in_the_last_pass_is_found(tap: Tap, monkeypatch: pytest.MonkeyPatch) -> None:
    take = Capture.take

    def take_wrongly(capture: Capture, captured: CaptureData) -> bool:
        last = captured.offset + len(captured.data) // 2 == captured.end
        damaged = replace(captured, data=captured.data[:-1] + b"\x55")
        return take(capture, damaged if captured.tap == tap and last else captured)

    monkeypatch.setattr(Capture, "take", take_wrongly)
    report = play().report
    assert report.decoded_equals_offline is (tap != Tap.DECODED)
    assert report.dac_equals_offline is (tap != Tap.DAC)


def test_what_would_be_too_long_is_played_without_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = play()
    monkeypatch.setattr(playback, "MAX_COMPARED_SAMPLES", LOOPS * SAMPLES)
    outcome = play()
    assert outcome.report.underruns == 0
    assert outcome.report.decoded_equals_offline is outcome.report.dac_equals_offline is None
    assert "computed here" in outcome.caption
    for trace, same in zip(outcome.traces[:2], compared.traces[:2], strict=True):
        np.testing.assert_array_equal(trace.values, same.values)
    skin, read_back = outcome.traces[2].values, compared.traces[2].values
    np.testing.assert_array_equal(skin[: len(skin) * 9 // 10], read_back[: len(skin) * 9 // 10])


@pytest.mark.parametrize("actuator", [replace(PIEZO_STACK, dac_bits=12), replace(LRA, dac_rate_hz=6000)])
def test_known_actuator_is_modelled_with_the_dac_that_its_controller_has(actuator: Actuator) -> None:
    assert play(actuator).report.dac_equals_offline is True


def test_codes_of_an_own_actuator_are_compared_where_its_file_is_given() -> None:
    """Its name may be one that ships: the limits that the controller does not tell are still its own."""
    own = replace(LRA, corner_hz=161.3, power_limit=0.01)
    stream = encode_recording(texture(SINE), live=True).stream
    _, controller = linked(Settings(actuator=own))
    for given, is_equal in ((None, None), (LRA, None), (own, True)):
        report = playback.play(session_with(controller, "serial:a", given), "sine", stream).report
        assert (report.decoded_equals_offline, report.dac_equals_offline) == (True, is_equal)
        assert (report.comparison_note is None) == (is_equal is True)


def uploaded(actuator: Actuator, controller: Controller) -> str:
    """Upload an actuator; return the name of the one that the controller then drives."""
    uploader.flash(controller, image(actuator))
    return controller.description.actuator.name


def test_an_uploaded_actuator_is_driven_until_another_image_runs() -> None:
    own = replace(LRA, name="own", corner_hz=161.3, power_limit=0.01)
    stream = encode_recording(texture(SINE), live=True).stream
    _, controller = linked(Settings(actuator=LRA))
    assert uploaded(own, controller) == "own"
    assert playback.play(session_with(controller, "serial:a", own), "sine", stream).report.dac_equals_offline is True
    uploader.flash(controller, models.find("mdct-textures").image)
    assert controller.description.actuator.name == "lra"
    uploader.roll_back(controller)
    assert controller.description.actuator.name == "own"


def test_firmware_with_narrower_limits_drives_its_own_actuator() -> None:
    flash, own = FlashMemory(FLASH_BYTES), replace(LRA, name="own")
    before = session(MemoryLink(SimulatedController(Settings(actuator=LRA), flash)))
    assert uploaded(own, before) == "own"
    after = session(MemoryLink(SimulatedController(Settings(actuator=replace(LRA, power_limit=0.1)), flash)))
    assert after.description.images == before.description.images
    assert after.description.actuator.name == "lra"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"dac_rate_hz": 4000}, "another DAC"),
        ({"dac_bits": 12}, "another DAC"),
        ({"volts_limit": 2.8}, "wider limits"),
        ({"slew_volts_per_second": 9000.0}, "wider limits"),
        ({"power_limit": 0.3}, "wider limits"),
    ],
)
def test_no_uploaded_actuator_lifts_a_limit_or_changes_the_dac(
    changes: dict[str, Any], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the controller itself, whatever the host checks."""
    monkeypatch.setattr(uploader, "check_fit", lambda *_: None)
    _, controller = linked(Settings(actuator=replace(LRA, volts_limit=2.0, slew_volts_per_second=8000.0)))
    own = replace(LRA, name="own", volts_limit=1.0, slew_volts_per_second=7000.0)
    with pytest.raises(ControllerError, match=reason):
        uploaded(replace(own, **changes), controller)
    assert uploaded(own, controller) == "own"


def test_an_image_whose_actuator_cannot_be_driven_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploader, "check_fit", lambda *_: None)
    _, controller = linked(Settings(actuator=LRA))
    whole = ModelImage.unpack(image(LRA))
    unstable = bytearray(whole.payload)
    unstable[-28:-24] = bytes(4)  # damping
    for payload in (bytes(unstable), b"\0" + whole.payload + b"\0\0\0", whole.payload + b"\0"):
        with pytest.raises(ControllerError, match="no actuator that can be driven"):
            uploader.flash(controller, replace(whole, payload=payload).pack())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stroke_um": 0.0}, "an impossible actuator"),
        ({"volts": math.nan}, "an impossible actuator"),
        ({"lower_hz": 300.0, "upper_hz": 300.0}, "an impossible actuator"),
        ({"slew_volts_per_second": math.inf}, "an impossible actuator"),
        ({"lower_hz": 200.0, "upper_hz": 200.001}, "compensation"),
        ({"dac_bits": 0}, "0 bits"),
        ({"dac_rate_hz": 3}, "resample"),
        ({"name": "x" * 40}, "name"),
    ],
)
def test_controller_with_an_impossible_actuator_is_rejected(
    changes: dict[str, Any], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_steps = Controller.open_session_steps

    def open_wrongly(controller: Controller) -> Steps[None]:
        yield from open_steps(controller)
        hello = controller.description
        described = replace(hello.actuator, **({"name": "unheard of"} | changes))
        controller.description = replace(hello, actuator=described)

    monkeypatch.setattr(Controller, "open_session_steps", open_wrongly)
    with pytest.raises(ControllerError, match=reason):
        play()


@pytest.mark.parametrize("volts", [1.0, 3.3, 2.5, 7.77])
def test_a_known_actuator_at_other_volts_is_known_too(volts: float) -> None:
    driven = devices.on_sound_card(VOICE_COIL, 48_000, volts)
    with devices.connect("sim", actuator=driven) as controller:
        described = controller.description.actuator
    assert constants(actuator_model(described)) == constants(driven)


@pytest.mark.parametrize("frequency_hz", [100, 200, 400])
def test_touch_is_that_of_the_displacement_asked_for(frequency_hz: int) -> None:
    rate_hz = PIEZO_STACK.dac_rate_hz
    asked_um = 10 * np.sin(2 * np.pi * frequency_hz * np.arange(2 * rate_hz) / rate_hz)[:, None]
    drive = signal.lfilter(*PIEZO_STACK.inverse(), asked_um / PIEZO_STACK.excursion_um, axis=0)
    touch = playback.touch_of(PIEZO_STACK, np.rint(drive * PIEZO_STACK.full_scale).astype(np.int16))
    frequencies_hz, levels_db = over_threshold_db(asked_um, rate_hz, read_threshold())
    assert touch.level_db == pytest.approx(max(levels_db), abs=0.1)
    assert touch.frequency_hz == pytest.approx(frequencies_hz[np.argmax(levels_db)])
