"""The image store in C over the simulated flash memory, as simulated_device.flash.ImageStore."""

from collections.abc import Callable
from typing import Any

from tests.firmware.native import ffi, native, piece_bytes, refusal_text
from vibrocast.codec import CodecError
from vibrocast.device_protocol.messages import ErrorCode, FlashStatus, ImageDescription, SlotState
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.simulated_device.flash import SLOTS, FlashMemory, PowerCut
from vibrocast.simulated_device.refusal import Refusal


class CImageStore:
    """As ImageStore; what the flash raises is raised again when the C function has returned."""

    def __init__(self, flash: FlashMemory, hardware: str, check_payload: Callable[[int, bytes], None]) -> None:
        self._memory = flash
        self._raised: Exception | None = None
        self._check_payload = check_payload
        self._contents = ffi.from_buffer(flash.contents)
        sector_bytes = flash.sector_bytes
        self._slot_bytes = (len(flash) // sector_bytes - 2) // SLOTS * sector_bytes
        self._erase = ffi.callback("int(void *, uint32_t, uint32_t)", self._on_erase)
        self._program = ffi.callback("int(void *, uint32_t, const uint8_t *, uint32_t)", self._on_program)
        self._check = ffi.callback("int(uint8_t, const uint8_t *, size_t, vc_refusal *)", self._on_check)
        self._flash = ffi.new("vc_flash *")
        self._flash.base = ffi.cast("const uint8_t *", self._contents)
        self._flash.record, self._flash.record_bytes = [0, sector_bytes], sector_bytes
        self._flash.slot = [2 * sector_bytes, 2 * sector_bytes + self._slot_bytes]
        self._flash.slot_bytes = self._slot_bytes
        self._flash.erase, self._flash.program = self._erase, self._program
        self._hardware = ffi.new("char[]", hardware.encode())
        self._store, self._refusal = ffi.new("vc_image_store *"), ffi.new("vc_refusal *")
        self._report = ffi.new("vc_flash_report *")
        native.vc_image_store_boot(self._store, self._flash, self._hardware, self._check)
        raised, self._raised = self._raised, None
        if isinstance(raised, PowerCut):
            raise raised

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
            found.append(ImageDescription(description.slot, description.state, sha256, name, version))
        return tuple(found)

    def begin(self, number: int, size_bytes: int, digest: bytes, hardware: str) -> FlashStatus:
        sha256, text = ffi.new("uint8_t[]", digest), ffi.new("uint8_t[]", hardware.encode())
        begin = ffi.new("vc_flash_begin *", [number, size_bytes, sha256, [text, len(hardware.encode())]])
        return self._status(native.vc_image_store_begin(self._store, begin, self._report, self._refusal))

    def write(self, number: int, offset: int, data: bytes) -> FlashStatus:
        memory = ffi.new("uint8_t[]", data)
        piece = ffi.new("vc_flash_data *", [number, offset, [memory, len(data)]])
        return self._status(native.vc_image_store_write(self._store, piece, self._report, self._refusal))

    def verify(self, number: int) -> FlashStatus:
        return self._status(native.vc_image_store_verify(self._store, number, self._report, self._refusal))

    def activate(self, number: int) -> FlashStatus:
        return self._status(native.vc_image_store_activate(self._store, number, self._report, self._refusal))

    def confirm(self, number: int) -> FlashStatus:
        return self._status(native.vc_image_store_confirm(self._store, number, self._report, self._refusal))

    def _status(self, refused: int) -> FlashStatus:
        raised, self._raised = self._raised, None
        if raised is not None:
            assert refused == ErrorCode.FLASH_FAILED
            raise raised
        if refused:
            assert refused == self._refusal.code
            raise Refusal(ErrorCode(refused), refusal_text(self._refusal))
        report = self._report
        sha256 = bytes(ffi.buffer(report.sha256, 32)) if report.sha256 else bytes(32)
        return FlashStatus(report.slot, SlotState(report.state), report.next_offset, sha256)

    def _on_erase(self, _: Any, offset: int, length: int) -> int:
        return self._change(lambda: self._memory.erase(offset, length))

    def _on_program(self, _: Any, offset: int, data: Any, length: int) -> int:
        return self._change(lambda: self._memory.program(offset, bytes(ffi.buffer(data, length))))

    def _change(self, change: Callable[[], None]) -> int:
        """Return 0 when the flash took a change, and 1 when it failed or the power is gone."""
        if not isinstance(self._raised, PowerCut):
            try:
                change()
            except (PowerCut, OSError) as error:
                self._raised = error
            else:
                return 0
        return 1

    def _on_check(self, codec_identifier: int, payload: Any, length: int, refusal: Any) -> int:
        try:
            self._check_payload(codec_identifier, bytes(ffi.buffer(payload, length)))
        except CodecError as error:
            return int(native.vc_refuse(refusal, ErrorCode.IMAGE_REFUSED, ffi.new("char[]", str(error).encode())))
        return 0
