"""The image store in C, over the simulated flash memory, with the interface of a Python class."""

from typing import Any

from tests.firmware.native import ffi, native, piece_bytes, rejection_text
from vibrocast.device_protocol.messages import ErrorCode, SlotState
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.output.actuator_constants import constants
from vibrocast.simulated_device.callbacks import Callbacks
from vibrocast.simulated_device.controller import signature_verifier
from vibrocast.simulated_device.flash import SLOTS, FlashMemory, FlashPort


class RequestError(Exception):
    """A request that the store rejects."""

    def __init__(self, code: ErrorCode, text: str) -> None:
        super().__init__(text)
        self.code = code


class CImageStore:
    """Two slots for model images of any payload. A PowerCut of the flash is raised when the C function has returned.

    Requests return the slot's state and the offset at which the next data belong.
    """

    def __init__(self, flash: FlashMemory, public_key: bytes = b"") -> None:
        self._callbacks = Callbacks(ffi)
        self._flash = FlashPort(ffi, flash, self._callbacks)
        self._check = self._callbacks.make("vc_payload_check", lambda *_: 0, -1)
        self._store, self._rejection = ffi.new("vc_image_store *"), ffi.new("vc_rejection *")
        self._report = ffi.new("vc_flash_status *")
        fields = {"hardware": ffi.new("char[]", b"sim"), "actuator": ffi.new("vc_actuator *", constants(PIEZO_STACK))}
        if public_key:
            fields["public_key"] = ffi.new("uint8_t[]", public_key)
            fields["verify_signature"] = signature_verifier(ffi, self._callbacks)
        self._settings = ffi.new("vc_controller_settings *", fields), fields
        native.vc_image_store_init(self._store, self._flash.pointer, self._settings[0], self._check, ffi.NULL)
        self._callbacks.pass_on()

    def boot_again(self) -> None:
        """Restart, as after FlashActivate: the power stays on."""
        native.vc_image_store_boot(self._store)
        self._callbacks.pass_on()

    @property
    def running(self) -> str:
        """The name of the image that runs; empty if none does."""
        image = native.vc_image_store_running(self._store)
        return piece_bytes(image.name).decode() if image else ""

    @property
    def running_sha256(self) -> bytes:
        sha256 = native.vc_image_store_running_sha256(self._store)
        return bytes(ffi.buffer(sha256, 32)) if sha256 else b""

    @property
    def states(self) -> list[SlotState]:
        return [SlotState(slot.state) for slot in self._described()]

    @property
    def numbers(self) -> list[int]:
        """The numbers of the images' releases."""
        return [slot.number for slot in self._described()]

    def _described(self) -> list[Any]:
        slots = [ffi.new("vc_image_description *") for _ in range(SLOTS)]
        for number, slot in enumerate(slots):
            native.vc_image_store_describe(self._store, number, slot)
        return slots

    def begin(self, slot: int, size_bytes: int, digest: bytes) -> tuple[SlotState, int]:
        sha256 = ffi.new("uint8_t[]", digest)
        return self._ask("begin", ffi.new("vc_flash_begin *", [slot, size_bytes, sha256, [ffi.NULL, 0]]))

    def write(self, slot: int, offset: int, data: bytes) -> tuple[SlotState, int]:
        memory = ffi.new("uint8_t[]", data)
        return self._ask("write", ffi.new("vc_flash_data *", [slot, offset, [memory, len(data)]]))

    def verify(self, slot: int) -> tuple[SlotState, int]:
        return self._ask("verify", slot)

    def activate(self, slot: int) -> tuple[SlotState, int]:
        return self._ask("activate", slot)

    def confirm(self, slot: int) -> tuple[SlotState, int]:
        return self._ask("confirm", slot)

    def erase(self, slot: int) -> tuple[SlotState, int]:
        return self._ask("erase", slot)

    def read(self, slot: int, offset: int, count: int) -> tuple[int, bytes]:
        """Return the size of the image and bytes of it."""
        contents = ffi.new("vc_flash_contents *")
        read = ffi.new("vc_flash_read *", [slot, offset, count])
        self._check_code(native.vc_image_store_read(self._store, read, contents, self._rejection))
        assert contents.slot == slot and contents.offset == min(offset, contents.size_bytes)
        return contents.size_bytes, piece_bytes(contents.data)

    def _ask(self, request: str, argument: Any) -> tuple[SlotState, int]:
        rejected = getattr(native, f"vc_image_store_{request}")(self._store, argument, self._report, self._rejection)
        self._callbacks.pass_on()
        self._check_code(rejected)
        return SlotState(self._report.state), self._report.next_offset

    def _check_code(self, rejected: int) -> None:
        if rejected:
            assert rejected == self._rejection.code
            raise RequestError(ErrorCode(rejected), rejection_text(self._rejection))
