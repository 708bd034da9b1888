"""The image store in C, over the simulated flash memory, with the interface of a Python class."""

from collections.abc import Callable
from typing import Any

from tests.firmware.native import ffi, native, piece_bytes, rejection_text
from vibrocast.codec import CodecError
from vibrocast.device_protocol.messages import ErrorCode, FlashStatus, ImageDescription, SlotState
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.simulated_device.callbacks import Callbacks
from vibrocast.simulated_device.controller import signature_verifier
from vibrocast.simulated_device.flash import SLOTS, FlashMemory, FlashPort


class RequestError(Exception):
    """A request that the store rejects."""

    def __init__(self, code: ErrorCode, text: str) -> None:
        super().__init__(text)
        self.code = code


class CImageStore:
    """Two slots for model images. A PowerCut of the flash is raised again when the C function has returned."""

    def __init__(
        self, flash: FlashMemory, hardware: str, check_payload: Callable[[int, bytes], None], public_key: bytes = b""
    ) -> None:
        self._check_payload = check_payload
        self._callbacks = Callbacks(ffi)
        self._flash = FlashPort(ffi, flash, self._callbacks)
        self._check = self._callbacks.make("vc_payload_check", self._on_check, -1)
        self._store, self._rejection = ffi.new("vc_image_store *"), ffi.new("vc_rejection *")
        self._report = ffi.new("vc_flash_status *")
        fields = {"hardware": ffi.new("char[]", hardware.encode())}
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
    def running(self) -> ModelImage | None:
        image = native.vc_image_store_running(self._store)
        if not image:
            return None
        name, version, hardware = (piece_bytes(text).decode() for text in (image.name, image.version, image.hardware))
        return ModelImage(image.codec, name, version, hardware, piece_bytes(image.payload))

    @property
    def running_sha256(self) -> bytes:
        sha256 = native.vc_image_store_running_sha256(self._store)
        return bytes(ffi.buffer(sha256, 32)) if sha256 else b""

    def describe(self) -> tuple[ImageDescription, ...]:
        description, found = ffi.new("vc_image_description *"), []
        for number in range(SLOTS):
            native.vc_image_store_describe(self._store, number, description)
            name, version = (piece_bytes(text).decode() for text in (description.name, description.version))
            sha256 = bytes(ffi.buffer(description.sha256, 32))
            held = ImageDescription(
                description.slot, description.state, sha256, name, version, number=description.number
            )
            found.append(held)
        return tuple(found)

    def begin(self, number: int, size_bytes: int, digest: bytes, hardware: str) -> FlashStatus:
        sha256, text = ffi.new("uint8_t[]", digest), ffi.new("uint8_t[]", hardware.encode())
        begin = ffi.new("vc_flash_begin *", [number, size_bytes, sha256, [text, len(hardware.encode())]])
        return self._status(native.vc_image_store_begin(self._store, begin, self._report, self._rejection))

    def write(self, number: int, offset: int, data: bytes) -> FlashStatus:
        memory = ffi.new("uint8_t[]", data)
        piece = ffi.new("vc_flash_data *", [number, offset, [memory, len(data)]])
        return self._status(native.vc_image_store_write(self._store, piece, self._report, self._rejection))

    def verify(self, number: int) -> FlashStatus:
        return self._status(native.vc_image_store_verify(self._store, number, self._report, self._rejection))

    def activate(self, number: int) -> FlashStatus:
        return self._status(native.vc_image_store_activate(self._store, number, self._report, self._rejection))

    def confirm(self, number: int) -> FlashStatus:
        return self._status(native.vc_image_store_confirm(self._store, number, self._report, self._rejection))

    def _status(self, rejected: int) -> FlashStatus:
        self._callbacks.pass_on()
        if rejected:
            assert rejected == self._rejection.code
            raise RequestError(ErrorCode(rejected), rejection_text(self._rejection))
        report = self._report
        sha256 = bytes(ffi.buffer(report.sha256, 32)) if report.sha256 else bytes(32)
        return FlashStatus(report.slot, SlotState(report.state), report.next_offset, sha256)

    def _on_check(self, _: Any, codec_identifier: int, payload: Any, length: int, rejection: Any) -> int:
        try:
            self._check_payload(codec_identifier, bytes(ffi.buffer(payload, length)))
        except CodecError as error:
            return int(native.vc_reject(rejection, ErrorCode.IMAGE_REJECTED, ffi.new("char[]", str(error).encode())))
        return 0
