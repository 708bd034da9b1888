"""Flashes a model image into a controller: transfer, verify, test, confirm; goes on where a cut left it."""

import contextlib
import logging
from collections.abc import Callable
from dataclasses import replace

from vibrocast import models
from vibrocast.device_protocol.coded_stream import IMAGE_HASH_BYTES
from vibrocast.device_protocol.messages import (
    ErrorCode,
    FlashActivate,
    FlashBegin,
    FlashConfirm,
    FlashContents,
    FlashData,
    FlashErase,
    FlashRead,
    FlashStatus,
    FlashVerify,
    ImageDescription,
    SlotState,
    pack,
)
from vibrocast.device_protocol.model_image import (
    ACTUATOR_IDENTIFIER,
    MAX_IMAGE_BYTES,
    MAX_NUMBER,
    ModelError,
    ModelImage,
    sha256,
    signed_message,
    with_signature,
)
from vibrocast.device_protocol.transports import TransportError
from vibrocast.firmware import keys
from vibrocast.host.controller import ConnectionLost, Controller, ControllerError
from vibrocast.host.devices import SIMULATED
from vibrocast.output.actuator_constants import dac_of

RECONNECT_S = 10.0

# docs/reference/protocol.md: erasing or reading a whole slot takes its time.
_SLOT_TIMEOUT_S = 0.5
_MAX_CUTS = 20
_RESTART_S = 10.0
_RESTART_PAUSE_S = 0.1
_log = logging.getLogger(__name__)
_RUNNING = (SlotState.TESTING, SlotState.CONFIRMED)


def flash(
    controller: Controller,
    image: bytes,
    slot: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    confirm: bool = True,
) -> ImageDescription:
    """Flash a packed model image, start it as a test, confirm it; return what the slot then holds.

    `confirm`: False = it stays a test, so that the image before runs again after the next restart. `slot`: None = one
    that is not running. `progress` is called with the bytes that the slot has and the image's size.
    A cut connection is opened again for RECONNECT_S, and the transfer resumed; a later call resumes it as well.
    An image that runs already is left alone. Raises ModelError, also for an image without the signature that the
    controller needs, ControllerError, TransportError, MessageError.
    """
    public_key = controller.description.public_key
    model = check_signature(image, public_key) if public_key else ModelImage.unpack(image)
    check_fit(controller, model)
    identity = sha256(image)

    def described(slot: int, state: SlotState) -> ImageDescription:
        # A controller reads the name from the image itself: it shows that the image is whole, and so can run.
        return ImageDescription(slot, state, identity, model.name, model.version, number=model.number)

    for found in controller.description.images:
        if slot in (None, found.slot) and found == described(found.slot, SlotState.CONFIRMED):
            return found
        if slot in (None, found.slot) and found == described(found.slot, SlotState.TESTING):
            return _confirm(controller, described(found.slot, SlotState.CONFIRMED))
    if slot is None:
        slot = _free_slot(controller)
    begin = FlashBegin(slot, len(image), identity, model.hardware)
    _log.info("uploads %s %s, %d bytes, to slot %d", model.name, model.version, len(image), slot)
    resumed_at, cuts = -1, 0
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
            if received <= resumed_at or cuts == _MAX_CUTS:
                raise  # nothing was gained since the last cut, or too little
            resumed_at, cuts = received, cuts + 1
            _log.warning("upload cut at byte %d", received)
            controller.reconnect(RECONNECT_S)
    if verified.sha256 != identity or verified.state != SlotState.VERIFIED:
        raise ControllerError(f"verification failed for slot {slot}: data differs; upload it again")
    _start_test(controller, described(slot, SlotState.TESTING))
    if not confirm:
        return described(slot, SlotState.TESTING)
    return _confirm(controller, described(slot, SlotState.CONFIRMED))


def check_fit(controller: Controller, model: ModelImage) -> None:
    """Raise ControllerError where a controller cannot use a model image, before anything is written."""
    hello = controller.description
    if model.hardware not in ("", hello.hardware):
        raise ControllerError(
            f"the model {model.name} is for the hardware {model.hardware}, and the controller is {hello.hardware}; "
            "give another model, or connect the board that it is for",
            ErrorCode.WRONG_HARDWARE,
        )
    if model.codec_identifier == ACTUATOR_IDENTIFIER:
        bits, rate_hz = hello.actuator.dac_bits, hello.actuator.dac_rate_hz
        if dac_of(model.payload) != (bits, rate_hz):
            raise ControllerError(
                f"the actuator {model.name} is for another DAC, and the controller's has {bits} bits and {rate_hz} Hz; "
                "change the actuator's file"
            )
    elif model.codec_identifier not in [identifier for identifier, _ in hello.codecs]:
        names = ", ".join(name for _, name in hello.codecs)
        raise ControllerError(
            f"the model {model.name} is for codec {model.codec_identifier}, and the controller has {names}; give "
            "another model, or update the firmware",
            ErrorCode.UNKNOWN_CODEC,
        )


def read_back(
    controller: Controller, held: ImageDescription, progress: Callable[[int, int], None] | None = None
) -> bytes:
    """Return the packed model image that a slot holds, read from the controller.

    `progress` is called with the bytes that have come and the image's size. Raises ControllerError, also where the
    bytes are not those of the slot's SHA-256, and TransportError.
    """
    image = b""
    room = controller.description.limits.max_payload_bytes - len(pack(FlashContents(0, 0, 0, b"")))
    while True:
        contents = controller.request(FlashRead(held.slot, len(image), room), FlashContents)
        image += contents.data
        size_bytes = contents.size_bytes
        if (contents.slot, contents.offset) != (held.slot, len(image) - len(contents.data)) or not (
            len(image) <= size_bytes <= MAX_IMAGE_BYTES and (contents.data or len(image) == size_bytes)
        ):
            raise ControllerError(
                f"the controller answers for slot {held.slot} with other bytes than asked for; update its firmware"
            )
        if progress is not None:
            progress(len(image), size_bytes)
        if len(image) == size_bytes:
            break
    if sha256(image) != held.sha256:
        raise ControllerError(f"slot {held.slot} does not hold the image that it names; upload it again")
    return image


def check_held(controller: Controller, image: bytes, progress: Callable[[int, int], None]) -> ImageDescription:
    """Compare a packed model image, byte by byte, with the slot that holds it; return what the slot holds.

    Raises ControllerError where no slot holds it, or it differs, and as `read_back`.
    """
    found = [held for held in controller.description.images if held.name and held.sha256 == sha256(image)]
    if not found:
        raise ControllerError("no slot holds this model; upload it")
    held = max(found, key=lambda held: held.state)
    if read_back(controller, held, progress) != image:
        raise ControllerError(f"slot {held.slot} holds this model with another signature; upload it again")
    return held


def erase(controller: Controller) -> list[int]:
    """Empty the slots that neither run nor are to be fallen back to; return their numbers.

    Raises as `Controller.request`, also while an image is on trial.
    """
    spare = [held.slot for held in controller.description.images if held.state not in _RUNNING]
    for slot in spare:
        controller.request(FlashErase(slot), FlashStatus, _SLOT_TIMEOUT_S)
    controller.open_session()
    return spare


def roll_back(controller: Controller) -> ImageDescription:
    """Run the verified image of the other slot, and confirm it; return it.

    Raises ControllerError where no other slot holds one, or it does not run, and TransportError.
    """
    others = [image for image in controller.description.images if image.state == SlotState.VERIFIED]
    if not others:
        raise ControllerError("no other slot holds a verified model image; upload one")
    run_again(controller, others[0])
    return replace(others[0], state=SlotState.CONFIRMED)


def running(controller: Controller) -> ImageDescription | None:
    """Return the model image that the controller said in its last hello that it runs, None if it runs none."""
    found = {image.state: image for image in controller.description.images}
    return next((found[state] for state in _RUNNING if state in found), None)


def run_again(controller: Controller, before: ImageDescription) -> None:
    """Start an image that ran before and is still in its slot, and confirm it.

    Raises ControllerError, also where the slot holds another one by now, and TransportError.
    """
    controller.open_session()
    found = running(controller)
    if found is not None and (found.slot, found.sha256) == (before.slot, before.sha256):
        return
    held = {image.slot: image.sha256 for image in controller.description.images}
    if held.get(before.slot) != before.sha256:
        raise ControllerError(f"slot {before.slot} no longer holds the image {before.name}; upload it again")
    _start_test(controller, replace(before, state=SlotState.TESTING))
    _confirm(controller, replace(before, state=SlotState.CONFIRMED))


def provide(controller: Controller, address: str, image: bytes) -> None:
    """See to it that the controller at an address runs a packed model image: flash a simulated one.

    Raises ControllerError for another one that runs something else, and as `flash`.
    """
    found = running(controller)
    if found is not None and found.sha256 == sha256(image):
        return
    if address in SIMULATED:
        flash(controller, image)
        return
    name = ModelImage.unpack(image).name
    # A name finds the models that ship alone.
    given = name if models.by_hash(sha256(image)) else "FOLDER"
    raise ControllerError(
        f"the stream needs the model {name} (image {sha256(image)[:IMAGE_HASH_BYTES].hex()}), the controller runs "
        f"{found.name if found else 'none'}; upload it first: `vibrocast flash {given} --device {address}`"
    )


def _free_slot(controller: Controller) -> int:
    """Return the slot to flash: one whose transfer was cut first, so that it is resumed."""
    free = [image for image in controller.description.images if image.state not in _RUNNING]
    if not free:
        tested = [image.name for image in controller.description.images if image.state == SlotState.TESTING]
        raise ControllerError(
            f"no slot is free while {tested[0]} is on trial; upload it again, which confirms it, or restart the "
            "controller"
            if tested
            else "the controller has no free slot for a model image; use another controller"
        )
    return min(free, key=lambda image: (image.state != SlotState.WRITING, image.state)).slot


def _send_piece(controller: Controller, slot: int, image: bytes, offset: int) -> int:
    """Send the piece at `offset`; return the offset to go on from."""
    room = controller.description.limits.max_payload_bytes - len(pack(FlashData(slot, 0, b"")))
    piece = image[offset : offset + room]
    next_offset = controller.request(FlashData(slot, offset, piece), FlashStatus).next_offset
    if not offset < next_offset <= offset + len(piece):  # flash takes whole writes: it may leave a rest
        raise ControllerError(
            f"the controller goes on at byte {next_offset} instead of {offset + len(piece)}; upload it again"
        )
    return next_offset


def _start_test(controller: Controller, wanted: ImageDescription) -> None:
    """Activate the slot and wait until the controller runs the image in it. Raises ControllerError if it does not."""
    # A restart may cut off the answer; what counts is what runs afterwards.
    with contextlib.suppress(TransportError, ConnectionLost):
        controller.request(FlashActivate(wanted.slot), FlashStatus)
    deadline_s = controller.clock() + _RESTART_S
    while True:
        controller.reconnect(_RESTART_S, restarts=True)
        if wanted in controller.description.images:
            return
        if controller.clock() >= deadline_s:
            raise ControllerError(
                f"the controller did not start the image in slot {wanted.slot}, and runs the previous one; "
                "upload it again"
            )
        controller.sleep(_RESTART_PAUSE_S)


def _confirm(controller: Controller, wanted: ImageDescription) -> ImageDescription:
    """Keep the image that is being tested. Raises ControllerError if the controller does not."""
    controller.request(FlashConfirm(wanted.slot), FlashStatus)
    controller.open_session()
    if wanted not in controller.description.images:
        raise ControllerError(f"the controller did not keep the image in slot {wanted.slot}; upload it again")
    return wanted


def signed(image: bytes, private_key: bytes, number: int) -> bytes:
    """Return a packed model image with a signature, in place of any before.

    `number`: of the release, from 1 on; a controller takes none below the highest one confirmed. Raises
    ModelError for bytes that are no image, or another number, and MissingExtraError.
    """
    ModelImage.unpack(image)
    if not 1 <= number <= MAX_NUMBER:
        raise ModelError(f"the number {number} is not in 1 to {MAX_NUMBER}; count releases from 1 on")
    return with_signature(image, number, keys.sign(private_key, signed_message(image, number)))


def check_signature(image: bytes, public_key: bytes) -> ModelImage:
    """Return the image that the owner of a public key has signed.

    Raises ModelError for any other, and MissingExtraError.
    """
    held = ModelImage.unpack(image)
    if not held.signature:
        raise ModelError(f"the model image {held.name} has no signature; sign it with `vibrocast keys sign`")
    if not keys.is_signed(held.signature, public_key, signed_message(image, held.number)):
        raise ModelError(
            f"the signature of the model image {held.name} is not by the key {public_key.hex()[:16]}, or the image has "
            "changed; sign it with that key"
        )
    return held
