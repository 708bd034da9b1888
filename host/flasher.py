"""Flashes a model image into a controller: transfer, verify, trial, confirm; goes on where a cut left it."""

import contextlib
from collections.abc import Callable

from device_protocol.messages import (
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashData,
    FlashStatus,
    FlashVerify,
    ImageDescription,
    SlotState,
    pack,
)
from device_protocol.model_image import ModelImage, sha256
from device_protocol.transports import TransportError
from host.controller import ConnectionLost, Controller, ControllerError

RECONNECT_S = 10.0

# docs/protocol.md: erasing or reading a whole slot takes its time.
_SLOT_TIMEOUT_S = 0.5
_RESTART_S = 10.0
_RESTART_PAUSE_S = 0.1
_RUNNING = (SlotState.TRIAL, SlotState.CONFIRMED)


def flash(
    controller: Controller,
    image: bytes,
    slot: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    reconnect_s: float = RECONNECT_S,
) -> ImageDescription:
    """Flash a packed model image, start it on trial, confirm it; return what the slot then holds.

    `slot`: None = one that is not running. `progress` is called with the bytes that the slot has and the image's size.
    A cut connection is opened anew for `reconnect_s` and the transfer resumed; a later call resumes it as well.
    An image that runs already is left alone. Raises ModelImageError, ControllerError, TransportError, MessageError.
    """
    hardware = ModelImage.unpack(image).hardware
    identity = sha256(image)
    for found in controller.description.images:
        if found.sha256 == identity and found.state in _RUNNING and slot in (None, found.slot):
            return found if found.state == SlotState.CONFIRMED else _confirm(controller, found.slot)
    if slot is None:
        slot = _free_slot(controller)
    begin = FlashBegin(slot, len(image), identity, hardware)
    resumed_at = -1
    while True:
        received = 0
        try:
            received = controller.request(begin, FlashStatus, _SLOT_TIMEOUT_S).next_offset
            while received < len(image):
                received = _send_piece(controller, slot, image, received)
                if progress is not None:
                    progress(received, len(image))
            verified = controller.request(FlashVerify(slot), FlashStatus, _SLOT_TIMEOUT_S)
            break
        except (TransportError, ConnectionLost):
            if received <= resumed_at:
                raise  # nothing was gained since the last cut
            resumed_at = received
            controller.reconnect(reconnect_s)
    if verified.sha256 != identity or verified.state != SlotState.VERIFIED:
        raise ControllerError(
            f"slot {slot} reads back otherwise than it was written. Flash it again or use another slot."
        )
    _start_trial(controller, slot)
    return _confirm(controller, slot)


def _free_slot(controller: Controller) -> int:
    """Return the slot to flash: one whose transfer was cut first, so that it is resumed."""
    free = [image for image in controller.description.images if image.state not in _RUNNING]
    if not free:
        raise ControllerError("the controller has no slot to flash: it takes no model images")
    return min(free, key=lambda image: (image.state != SlotState.WRITING, image.state)).slot


def _slot(controller: Controller, slot: int) -> ImageDescription:
    for image in controller.description.images:
        if image.slot == slot:
            return image
    raise ControllerError(f"the controller has no slot {slot}")


def _send_piece(controller: Controller, slot: int, image: bytes, offset: int) -> int:
    """Send the piece at `offset`; return the offset to go on from."""
    room = controller.description.limits.maximum_payload_bytes - len(pack(FlashData(slot, 0, b"")))
    piece = image[offset : offset + room]
    next_offset = controller.request(FlashData(slot, offset, piece), FlashStatus).next_offset
    if next_offset != offset + len(piece):
        raise ControllerError(
            f"the controller wrote up to byte {next_offset} instead of {offset + len(piece)}. Flash again."
        )
    return next_offset


def _start_trial(controller: Controller, slot: int) -> None:
    """Activate the slot and wait until the controller runs it. Raises ControllerError if it does not."""
    # A restart may cut off the answer; what counts is what runs afterwards.
    with contextlib.suppress(TransportError, ConnectionLost):
        controller.request(FlashActivate(slot), FlashStatus)
    deadline_s = controller.clock() + _RESTART_S
    while True:
        controller.reconnect(_RESTART_S)
        if _slot(controller, slot).state == SlotState.TRIAL:
            return
        if controller.clock() >= deadline_s:
            raise ControllerError(f"the controller did not start the image in slot {slot}: it runs the one before.")
        controller.sleep(_RESTART_PAUSE_S)


def _confirm(controller: Controller, slot: int) -> ImageDescription:
    controller.request(FlashConfirm(slot), FlashStatus)
    controller.say_hello()
    return _slot(controller, slot)
