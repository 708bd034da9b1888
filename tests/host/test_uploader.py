"""Flashing: the whole way, cuts, rejections, images that do not start."""

from dataclasses import replace
from typing import Any

import pytest

from tests.conftest import linked
from tests.host.scripted_controller import ScriptedController
from vibrocast import models
from vibrocast.device_protocol.messages import (
    Error,
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashContents,
    FlashData,
    FlashStatus,
    FlashVerify,
    ImageDescription,
    Message,
    SlotState,
)
from vibrocast.device_protocol.model_image import ModelError, ModelImage, sha256
from vibrocast.firmware import keys
from vibrocast.host import uploader
from vibrocast.host.controller import ControllerError
from vibrocast.host.uploader import flash

IMAGE = ModelImage(1, "oak", "1.0", "none", bytes(range(256)) * 20).pack()
IMAGES_ON_TRIAL = (
    ImageDescription(0, SlotState.CONFIRMED),
    ImageDescription(1, SlotState.TESTING, sha256(IMAGE), "oak", "1.0"),
)


def test_image_without_the_signature_that_the_controller_needs_is_not_sent() -> None:
    scripted = ScriptedController()
    scripted.description = replace(scripted.description, public_key=keys.public_key(bytes(32)))
    for image in (IMAGE, uploader.signed(IMAGE, b"x" * 32, 1)):
        with pytest.raises(ModelError, match="signature"):
            flash(scripted.connect(), image)
    assert not any(isinstance(message, FlashBegin) for message in scripted.handled)


def test_release_with_another_number_is_another_image() -> None:
    scripted = ScriptedController()
    first, second = (uploader.signed(IMAGE, bytes(32), number) for number in (1, 2))
    assert flash(scripted.connect(), first).number == 1
    before = len(scripted.handled)
    assert flash(scripted.connect(), first).number == 1
    assert not any(isinstance(message, FlashBegin) for message in scripted.handled[before:])
    scripted.flash = bytearray()
    assert flash(scripted.connect(), second, slot=1).number == 2


def test_cut_in_the_middle_is_resumed_without_sending_again() -> None:
    scripted = ScriptedController()

    def unplug() -> None:
        cut = len(scripted.flash) > 2000 and not scripted.reopened
        scripted.unplugged = cut and scripted.now_s < 2

    scripted.at_read = unplug
    assert flash(scripted.connect(), IMAGE).state == SlotState.CONFIRMED
    assert scripted.reopened >= 1
    offsets = [message.offset for message in scripted.handled if isinstance(message, FlashData)]
    assert offsets == sorted(set(offsets))
    assert sum(isinstance(message, FlashBegin) for message in scripted.handled) == 2


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (FlashContents(0, len(IMAGE), 0, IMAGE[:100]), "other bytes than asked for"),
        (FlashContents(1, len(IMAGE), 7, IMAGE[:100]), "other bytes than asked for"),
        (FlashContents(1, len(IMAGE), 0, b""), "other bytes than asked for"),
        (FlashContents(1, 0xFFFFFFFF, 0, IMAGE[:100]), "other bytes than asked for"),
        (FlashContents(1, 99, 0, IMAGE[:100]), "other bytes than asked for"),
        (FlashContents(1, 100, 0, IMAGE[:100]), "does not hold the image that it names"),
    ],
)
def test_bytes_that_are_not_the_image_are_not_read_back(answer: FlashContents, told: str) -> None:
    class Liar(ScriptedController):
        def respond_to_flashing(self, message: Message) -> Message:
            return answer

    with pytest.raises(ControllerError, match=told):
        uploader.read_back(Liar().connect(), IMAGES_ON_TRIAL[1])


def test_a_controller_of_an_older_version_is_not_asked_to_read_back() -> None:
    scripted = ScriptedController()
    scripted.description = replace(scripted.description, minor=1)
    with pytest.raises(ControllerError, match=r"speaks protocol 2\.1, which has no FlashRead; update its firmware"):
        uploader.read_back(scripted.connect(), IMAGES_ON_TRIAL[1])


@pytest.mark.parametrize("fallen_back", [{"state": SlotState.VERIFIED}, {"name": "", "version": ""}])
def test_image_that_does_not_start_is_reported_and_not_confirmed(fallen_back: dict[str, Any]) -> None:
    scripted = ScriptedController()

    def fall_back() -> None:
        if FlashActivate(1) in scripted.handled:
            images = [image if image.slot == 0 else replace(image, **fallen_back) for image in IMAGES_ON_TRIAL]
            scripted.description = replace(scripted.description, images=tuple(images))

    scripted.at_read = fall_back
    with pytest.raises(ControllerError, match="did not start"):
        flash(scripted.connect(), IMAGE)
    assert not any(isinstance(message, FlashConfirm) for message in scripted.handled)


def test_image_that_is_not_kept_is_reported() -> None:
    scripted = ScriptedController()
    scripted.answer = lambda message: (
        FlashStatus(1, SlotState.TESTING, 0) if isinstance(message, FlashConfirm) else None
    )
    with pytest.raises(ControllerError, match="did not keep"):
        flash(scripted.connect(), IMAGE)


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (FlashStatus(1, SlotState.WRITING, 3), "goes on at byte 3"),
        (Error(ErrorCode.FLASH_FAILED, "worn out"), "worn out"),
    ],
)
def test_data_that_is_not_taken_is_an_error(wrong: Message, reason: str) -> None:
    scripted = ScriptedController()
    scripted.answer = lambda message: wrong if isinstance(message, FlashData) else None
    with pytest.raises(ControllerError, match=reason):
        flash(scripted.connect(), IMAGE)


def test_other_bytes_read_back_are_an_error_and_nothing_is_activated() -> None:
    scripted = ScriptedController()
    answer = FlashStatus(1, SlotState.VERIFIED, len(IMAGE), bytes(32))
    scripted.answer = lambda message: answer if isinstance(message, FlashVerify) else None
    with pytest.raises(ControllerError, match="verification failed for slot 1: data differs"):
        flash(scripted.connect(), IMAGE)
    assert not any(isinstance(message, FlashActivate) for message in scripted.handled)


def test_image_left_on_trial_is_confirmed() -> None:
    scripted = ScriptedController()
    scripted.description = replace(scripted.description, images=IMAGES_ON_TRIAL)
    scripted.flash = bytearray(IMAGE)
    scripted.begun = FlashBegin(1, len(IMAGE), sha256(IMAGE), "none")
    assert flash(scripted.connect(), IMAGE).state == SlotState.CONFIRMED
    assert not any(isinstance(message, FlashData) for message in scripted.handled)


@pytest.mark.parametrize(
    ("images", "message"),
    [((), "no free slot"), (IMAGES_ON_TRIAL, f"{IMAGES_ON_TRIAL[1].name} is on trial; upload it again")],
    ids=["none", "on trial"],
)
def test_controller_without_a_free_slot_is_an_error(images: tuple[ImageDescription, ...], message: str) -> None:
    scripted = ScriptedController()
    scripted.description = replace(scripted.description, images=images)
    with pytest.raises(ControllerError, match=message):
        flash(scripted.connect(), replace(ModelImage.unpack(IMAGE), version="1.1").pack())


def test_a_model_stays_on_trial_and_the_one_before_comes_back() -> None:
    first, second = (models.find(name) for name in ("eva-16-3", "eva-16-4"))
    _, controller = linked()
    assert flash(controller, first.image).state == SlotState.CONFIRMED
    with pytest.raises(ControllerError, match="no other slot holds a verified model image"):
        uploader.roll_back(controller)
    assert flash(controller, second.image, confirm=False).state == SlotState.TESTING
    assert flash(controller, second.image).state == SlotState.CONFIRMED
    assert uploader.roll_back(controller).name == "eva-16-3"
    controller.open_session()
    found = uploader.running(controller)
    assert found is not None and (found.name, found.state) == ("eva-16-3", SlotState.CONFIRMED)


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (ModelImage(1, "oak", "1.0", "another board", b"x"), "is for the hardware another board"),
        (ModelImage(14, "oak", "1.0", "", b"x"), "is for codec 14, and the controller has"),
    ],
)
def test_a_model_that_does_not_fit_is_rejected_before_anything_is_written(image: ModelImage, problem: str) -> None:
    _, controller = linked()
    with pytest.raises(ControllerError, match=problem):
        flash(controller, image.pack())
    controller.open_session()
    assert {slot.state for slot in controller.description.images} == {SlotState.EMPTY}
